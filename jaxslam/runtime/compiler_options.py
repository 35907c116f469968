"""Compiler options of XLA, JAX's compiler, for the programs of jaxslam.

XLA drops options from one release to the next, and refuses a program that asks for one it has dropped. They only decide
how fast a program is compiled and runs, so that each is used where it is known.
"""

import functools
import logging
from collections.abc import Mapping

import jax
from jaxlib import version

_log = logging.getLogger(__name__)

_HAS_OLDER_GENERATOR = version.__version_info__ < (0, 11, 1)
"""Whether the installed XLA has its older generator of code, and the option that chooses one."""

FAST_COMPILE: dict[str, bool | str] = {"xla_cpu_use_fusion_emitters": False} if _HAS_OLDER_GENERATOR else {}
"""Compiler options of `jax.jit` for programs of many small parts, such as `track_step` and its gradient.

They are written by XLA's older generator of code; empty where jaxlib has none, from 0.11.1 on. The tracker is compiled
in 17 s instead of 35 (AMD EPYC, two cores), and a frame takes as long, within 3 %. The gradient of a step takes 0.8 GB
of memory to compile instead of 1.8, and three quarters of the time.
"""

SINGLE_THREAD: dict[str, bool | str] = {
    "xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
    "xla_cpu_multi_thread_eigen": False,
}
"""Options of `jax.jit` for a program that runs beside another: one part after the other, nearly all in the calling
thread, and so at its priority.

XLA else hands parts that do not depend on each other to a pool of threads, even if that has one thread only, and they
wait there behind those of other programs. Beside optical flow, 0.3 ms of work for masks took 2.1 ms; beside bundle
adjustment, the pose of a frame took 11.5 ms in the median, and 5.5 with both options (fr1_rpy live, AMD EPYC). With
nothing beside, programs take as long.

That holds while at most nine parts can run at once. Of more, XLA hands half to the pool, with all that comes after
them, and the program ends there: so went 95 of 100 ms of bundle adjustment and 60 of tracking, and a frame that came
meanwhile waited for up to 35 ms. Kernels keep below that with `jaxslam_kernels.program_parts.apart`;
`TF_CPP_VMODULE=thunk_executor=6` in the environment makes XLA print how the parts of a program depend on each other.
"""

FUSION_EMITTERS: dict[str, bool | str] = {"xla_cpu_use_fusion_emitters": True} if _HAS_OLDER_GENERATOR else {}
"""Options of `jax.jit` for a program that computes much for every pixel: XLA's newer generator of code, whatever
`XLA_FLAGS` says. With the older one a frame of a room takes 111 ms instead of 63 (640x480, one thread, AMD EPYC).
"""


def known_options(options: Mapping[str, bool | str]) -> dict[str, bool | str]:
    """Return those of some compiler options that the installed XLA knows; the others are logged.

    It starts JAX's backend, so that nothing can be set in `jax.config` about it afterwards.

    Args:
        options: Values by the names of the options.
    """
    return {name: value for name, value in options.items() if _is_known(name, value)}


@functools.cache
def _is_known(name: str, value: bool | str) -> bool:
    """Tell whether XLA knows an option, by compiling a small program with it: 20 ms, once a process."""
    try:
        jax.jit(lambda: 0.0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError as refusal:
        if f"No such compile option: '{name}'" not in str(refusal):
            raise
        _log.info("jaxlib %s has no compiler option %s: compiling without it", version.__version__, name)
        return False
    return True
