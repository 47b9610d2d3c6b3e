"""Orchestration: the only place that imports Prefect, and the `presight` command."""
