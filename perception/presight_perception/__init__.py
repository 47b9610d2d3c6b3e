"""PreSight's priors at work in perception models: dataset, voxels, fusion, metrics."""
