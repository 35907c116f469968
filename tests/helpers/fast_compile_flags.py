"""XLA's flags with which tests compile; as a script, printed for processes that load what tests have compiled."""

import jaxlib.version

_OLDER_GENERATOR = "--xla_cpu_use_fusion_emitters=false"
"""XLA's older generator of code, which the tracker is compiled by. XLA ends a process that names an unknown option."""
FAST_COMPILE_FLAGS = [
    *([_OLDER_GENERATOR] if jaxlib.version.__version_info__ < (0, 11, 1) else []),
    "--xla_cpu_parallel_codegen_split_count=1",  # a program as one module: 6 % faster
]

if __name__ == "__main__":
    print(*FAST_COMPILE_FLAGS)
