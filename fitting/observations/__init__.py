"""What was measured, checked once on the way in."""
