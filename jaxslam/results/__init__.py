"""The files of a run: trajectories, summary, frame table, pictures, dense map."""
