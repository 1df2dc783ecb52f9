"""Objects, lamps and range maps in the light of a closed form."""
