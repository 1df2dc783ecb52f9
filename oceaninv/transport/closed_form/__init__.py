"""Light of one homogeneous water in closed form."""
