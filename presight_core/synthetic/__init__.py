"""A procedural city, pictures of it with exact ground truth, and drives through it in the nuScenes format."""
