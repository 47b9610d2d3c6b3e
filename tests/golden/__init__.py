"""Golden values of reference implementations, and this project's answers to the same inputs."""
