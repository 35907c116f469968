from .point_cloud import DenseCloud as DenseCloud
