"""Pure, compiled, differentiable kernels of jaxslam: arrays in, arrays out, nothing else."""
