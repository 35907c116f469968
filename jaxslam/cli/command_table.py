"""The commands of `jaxslam`: the one table of their names, help texts and modules, and that of the exit codes.

It imports nothing heavy: `jaxslam --help` prints from it, and only the module of the chosen command is imported.
"""

from enum import IntEnum
from importlib import import_module
from typing import Any, NamedTuple


class ExitCode(IntEnum):
    """Exit codes of all commands."""

    DONE = 0
    KNOWN_ERROR = 1
    USAGE = 2
    INTERRUPTED = 130

    @property
    def text(self) -> str:
        """Meaning of the code, in words."""
        return _EXIT_TEXTS[self]


_EXIT_TEXTS = {
    ExitCode.DONE: "done",
    ExitCode.KNOWN_ERROR: "an error, said in one line: bad input or settings, a failed run or check",
    ExitCode.USAGE: "an unknown command or option, or a network that is not on this machine",
    ExitCode.INTERRUPTED: "interrupted",
}


class Command(NamedTuple):
    """One command.

    Attributes:
        words: Words of the command after `jaxslam`.
        place: Module and class of its options, `module:Class`, in `jaxslam.cli`; `None` if it is nothing but
            the commands whose words begin with its own.
        about: Summary of the command in one line.
        more: More about it, for its own help.
        takes_gpu: Whether it computes on a GPU if JAX finds one; the tracker is made for the CPU.
    """

    words: tuple[str, ...]
    place: str | None
    about: str
    more: str = ""
    takes_gpu: bool = False

    @property
    def name(self) -> str:
        """Words of the command after `jaxslam`, as one text."""
        return " ".join(self.words)

    @property
    def description(self) -> str:
        """Description in the command's own help."""
        others = [f"jaxslam {command.name}: {command.about}" for command in below(self)]
        pointer = ["These have a --help of their own:", *others] if others else []
        return "\n\n".join(text for text in (self.about, self.more, *pointer) if text)

    def options(self) -> type[Any]:
        """The dataclass of its options, whose `main` runs it; its module is imported now.

        Raises:
            ValueError: If it has none.
        """
        if self.place is None:
            raise ValueError(f"{self.name}: expected a command with options of its own")
        module, name = self.place.split(":")
        return getattr(import_module(f"jaxslam.cli.{module}"), name)


COMMANDS = (
    Command(
        ("demo",),
        "run:Demo",
        "Render a room with walking people, track the camera through it, and evaluate.",
        "Needs no data. Leaves the files of `run` in `--out`.",
    ),
    Command(
        ("run",),
        "run:Run",
        "Track a recording and, if it has ground truth, evaluate.",
        "The dataset kind and the cameras of TUM (fr1, fr2, fr3) and Bonn are recognized from the folder.",
    ),
    Command(
        ("compare",),
        "compare:Compare",
        "Track a recording with several presets and put their figures into one table.",
        "With the presets given, it is Table V of NGD-SLAM: a static world, a detector whose every mask is waited for,"
        " masks propagated to the present, and flow between keyframes.",
    ),
    Command(
        ("bench",),
        "bench:Bench",
        "Run a suite: recordings or rendered rooms, presets, several seeds.",
        "Other systems are judged beside the presets. Without a suite, list those there are.",
    ),
    Command(
        ("bench", "accuracy"),
        "bench_accuracy:AccuracyRuler",
        "Compare accuracy with a frozen baseline, on real recordings and rendered rooms.",
        "Recordings are those at hand. Ten seeds or more each with the preset `default`, in two processes, in 10 to 20"
        " minutes. What counts is the geometric mean over recordings of the ratios of median errors, at most 1.04; no"
        " recording above 1.15; no fewer frames tracked. In the table, 'worst' is the largest ATE of a seed over the"
        " median, 'by chance' is where 95 % of the ratios lie if nothing but the seeds has changed, which is also what"
        " the rounding of another CPU does, and 'equal' counts seeds whose trajectory has the very bytes of the"
        " baseline.",
    ),
    Command(
        ("bench", "batch"),
        "bench_batch:Batch",
        "Track 1 to 64 clips at once with `vmap`, beside a loop.",
        "Frames a second, on the GPU where JAX has one. Nothing else should run on the machine meanwhile; some minutes."
        " `NPROC=1` before the command holds XLA to one thread.",
        takes_gpu=True,
    ),
    Command(
        ("bench", "compile"),
        "bench_compile:Compile",
        "Measure what compiling costs: instructions, kernels, seconds, memory.",
        "Of the step, its gradient, mapping, loop closing and the dense map, each in a process of its own, without"
        " caches; two minutes. With `--by-function`, also what each function of the source costs in a frame."
        " The counts of the step are a budget that a test compares.",
    ),
    Command(
        ("bench", "gate"),
        "bench_gate:Gate",
        "Run the suite of a baseline, and fail if errors, coverage or times are worse.",
    ),
    Command(
        ("bench", "kernels"),
        "bench_kernels:Kernels",
        "Measure each kernel beside OpenCV, SciPy, Ceres, gtsam or scikit-learn.",
        "Over sizes; on a GPU too if there is one. Nothing else should run on the machine meanwhile; some minutes.",
        takes_gpu=True,
    ),
    Command(
        ("bench", "live"),
        "bench_live:Live",
        "Time frames at the rate of the camera, in turn with other programs.",
        "Wall and processor time, median, 95th percentile, late frames, memory. Nothing else should run on the machine"
        " meanwhile.",
    ),
    Command(
        ("bench", "soak"),
        "bench_soak:Soak",
        "Track for hours in one place, and show what grows: keyframes, memory, time, error.",
        "Plays a recording or a world to and fro, with a covered lens and failures of the detector now and then; in a"
        " world, other people each time. An hour for 100,000 frames of the default; nothing else should run meanwhile"
        " if times are to mean something.",
    ),
    Command(
        ("eval",),
        "eval:Eval",
        "Compare an estimated trajectory with the truth: ATE, RPE and KITTI's figures.",
        "KITTI's t_rel and r_rel are for paths of 100 m or more. Formats (TUM, KITTI, EuRoC's ground truth,"
        " VSLAM-LAB) are recognized.",
    ),
    Command(
        ("doctor",),
        "doctor:Doctor",
        "Look a recording over before tracking it: files, times, calibration, depth.",
        "Scale of depth and quality of pictures too.",
    ),
    Command(
        ("calibrate",),
        "calibrate:Calibrate",
        "Calibrate the camera of a recording from the recording itself, without a target.",
        "Focal lengths, center, distortion, rolling shutter, and offset, delay and place of depth, each with its"
        " standard deviation. A value changes only if frames that were not fitted to are explained better. What a"
        " recording cannot tell, as the scale of depth, is called unobservable.",
    ),
    Command(
        ("calibrate", "noise"),
        "calibrate_noise:CalibrateNoise",
        "Estimate the noise of pixels and of depth or disparity from a recording, so that covariances are right.",
        "Tracks it forward and backward, and compares the motions with their covariances; without ground truth. Writes"
        " settings for `jaxslam run --config`. A setting changes only if held-out parts are more likely with it.",
    ),
    Command(
        ("export",),
        "export:Export",
        "Write a map for other programs.",
        "Points as PLY, all of it as a COLMAP model, keyframes as a trajectory.",
    ),
    Command(("learn",), None, "Train what jaxslam learns from rendered scenes."),
    Command(
        ("learn", "weights"),
        "learn_weights:LearnWeights",
        "Learn the weights of the cue `learned` from rendered rooms, by true labels and by the pose error.",
        "Rooms are rendered and tracked; real people are set into some of them where `JAXSLAM_DATA` and"
        " `JAXSLAM_MODELS` are set. The same seed gives the same file on the same machine.",
    ),
    Command(("models",), None, "Networks that find people: list them, get one, check one."),
    Command(
        ("models", "check"),
        "models_check:CheckModel",
        "Run a network on an image: what it finds, how long it takes, drawn.",
    ),
    Command(("models", "get"), "models:GetModel", "Download a network, or go on with a download that was cut."),
    Command(
        ("models", "list"), "models:ListModels", "Print the known networks: size, license, adapter, where they are."
    ),
    Command(("data",), None, "Public recordings to track: list them, get one."),
    Command(("data", "get"), "data:GetRecording", "Download a recording and unpack it, or go on with a cut download."),
    Command(("data", "list"), "data:ListRecordings", "Print the known recordings: size, license, where they are."),
    Command(("world",), None, "Rendered worlds: list them, look at one, make one into a recording."),
    Command(("world", "list"), "world:ListWorlds", "Print the worlds that come with jaxslam."),
    Command(
        ("world", "render"),
        "world:RenderWorld",
        "Render a world into a recording with exact ground truth.",
        "In the layout of TUM RGB-D, with masks, numbers and labels of all things, and the calibration.",
    ),
    Command(
        ("world", "show"),
        "world:ShowWorld",
        "Write pictures of a world: a contact sheet, a plan, a clip.",
    ),
)


def below(command: Command) -> tuple[Command, ...]:
    """The commands whose words begin with those of another one, and go on."""
    first = command.words
    return tuple(other for other in COMMANDS if other is not command and other.words[: len(first)] == first)


def find_command(words: list[str]) -> Command | None:
    """The command that the words of a command line call for: the longest that they begin with, if any."""
    called = [command for command in COMMANDS if tuple(words[: len(command.words)]) == command.words]
    return max(called, key=lambda command: len(command.words), default=None)
