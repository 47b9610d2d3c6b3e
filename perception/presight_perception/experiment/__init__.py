"""The paper's experiments: training and testing perception models with and without priors."""
