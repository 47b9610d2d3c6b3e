"""The only place of PreSight that writes what others read: catalog, drives, features, artifacts, priors."""
