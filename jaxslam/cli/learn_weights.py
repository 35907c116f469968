"""`jaxslam learn weights`: the weights of the cue `learned`, from rendered scenes."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxslam.cli.console import console, make_table, print_json, progress_bar
from jaxslam.cli.shared_options import WithJson

if TYPE_CHECKING:
    from jaxslam.learning.weights import LearnedWeights


@dataclass(frozen=True)
class LearnWeights(WithJson):
    """Options of `jaxslam learn weights`."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """File to write, JSON."""
    recipe: str | None = None
    """YAML file with the scenes and numbers of the training; that of the weights that come with jaxslam if not set."""
    seed: int = 0
    """Seed of the first weights and of the order of the frames."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.dynamics.network_file import save_network  # noqa: PLC0415
        from jaxslam.errors import ModelError  # noqa: PLC0415
        from jaxslam.io.atomic_files import make_folder  # noqa: PLC0415
        from jaxslam.learning.weights import learn_weights  # noqa: PLC0415
        from jaxslam.learning.weights_recipe import load_recipe  # noqa: PLC0415
        from jaxslam.runtime.compile_cache import enable_compile_cache  # noqa: PLC0415

        recipe = load_recipe(self.recipe)
        make_folder(self.out.parent, ModelError)
        enable_compile_cache()
        with progress_bar("{task.description}") as bar:
            task = bar.add_task("rendering scenes", total=None)

            def on_progress(text: str, done: int, total: int) -> None:
                bar.update(task, description=text, completed=done, total=total)

            found = learn_weights(recipe, seed=self.seed, on_progress=on_progress)
        figures = _figures(found)
        origin = {"command": f"jaxslam learn weights --seed {self.seed}", "seed": self.seed}
        if self.recipe is not None:
            origin["recipe"] = Path(self.recipe).name
        save_network(self.out, found.weights(), {**origin, "scenes": list(found.scenes), "held_out": figures})
        if self.json:
            print_json({"file": str(self.out), "scenes": list(found.scenes), "held_out": figures})
            return
        _print(figures)
        console.print(f"To use it: --set dynamics.cues=[learned] dynamics.learned.weights={self.out}")


def _figures(found: "LearnedWeights") -> list[dict[str, Any]]:
    return [
        {
            "stage": stage.stage,
            "wrong": round(stage.wrong.share, 5),
            "moving_kept": round(stage.wrong.moving_kept / max(stage.wrong.moving, 1), 5),
            "static_rejected": round(stage.wrong.static_rejected / max(stage.wrong.static, 1), 5),
            "ate_mm": round(1e3 * stage.ate_m, 3),
        }
        for stage in found.stages
    ]


def _print(figures: list[dict[str, Any]]) -> None:
    rows = [
        (each["stage"], *(f"{100 * each[key]:.2f} %" for key in ("wrong", "moving_kept", "static_rejected")),
         f"{each['ate_mm']:.2f} mm")
        for each in figures
    ]  # fmt: skip
    headings = ("after", "wrong points", "moving kept", "static rejected", "ATE")
    console.print(make_table("Held-out rooms", *headings, rows=rows))
