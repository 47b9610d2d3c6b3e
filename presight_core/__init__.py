"""The vocabulary and the mathematics of PreSight; knows no database and no Prefect."""
