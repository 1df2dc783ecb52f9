"""The commands of `oceaninv`, one module per job."""
