"""How code runs: compile and trace caches, aligned memory, padding, workers, stage times, the machine."""
