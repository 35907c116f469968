"""What compiling the programs of jaxslam costs: size, time and memory of each, and a budget for the step."""
