"""The basis of all other packages: numerics, published tables, spectra, the interface, files."""
