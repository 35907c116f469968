"""Run-time support: compile and trace caches, aligned memory, padding, workers, stage timer, machine description."""
