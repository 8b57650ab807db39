"""Reports, recordings and exported models."""
