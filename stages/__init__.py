"""The pipeline's stages, one module each: plain functions, no Prefect, no store, no clock."""
