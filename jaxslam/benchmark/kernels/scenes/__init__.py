"""Problems with known answers, on which kernels are compared."""
