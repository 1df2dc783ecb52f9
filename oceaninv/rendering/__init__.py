"""Pictures of a scene, and their files."""
