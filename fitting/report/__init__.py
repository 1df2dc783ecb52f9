"""Results as pictures, pages and files."""
