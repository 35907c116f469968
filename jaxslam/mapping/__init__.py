"""Local mapping: new points, triangulation, fusion, local bundle adjustment, culling, tracking the local map."""
