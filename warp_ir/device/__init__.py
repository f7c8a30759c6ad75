"""Where kernels run: all cores of a CPU, or a CUDA device; and how long that takes, by phase."""
