"""What every other package stands on: numerics, published tables, spectra, the interface, files."""
