"""k-means and DBSCAN with fixed shapes."""
