"""Light of any scene by random walks."""
