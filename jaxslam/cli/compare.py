"""`jaxslam compare`: several presets on one recording, several times each, in one table."""

from dataclasses import dataclass

from jaxslam.cli.console import print_json
from jaxslam.cli.run import OfRecording
from jaxslam.errors import ConfigError, nearest

# Heavy modules are imported where a command runs: `--help` needs none of them.


@dataclass(frozen=True)
class Compare(OfRecording):
    """Options of `jaxslam compare`."""

    presets: tuple[str, ...] = ("static", "ngd-detector", "ngd-propagation", "ngd-published")
    """What to compare."""
    runs: int = 1
    """How often to run each, with the seeds 0, 1, 2, ..."""

    def main(self) -> None:
        """Run the command."""
        from jaxslam.cli.compare_run import check_networks, compare_presets, print_tables, write_tables  # noqa: PLC0415
        from jaxslam.config.loading import presets  # noqa: PLC0415

        if self.runs < 1:
            raise ConfigError(f"--runs: expected at least 1, got {self.runs}")
        chosen = tuple(dict.fromkeys(self.presets))
        for preset in chosen:
            if preset not in presets():
                raise ConfigError(f"--presets: unknown preset '{preset}'{nearest(preset, presets())}")
        dataset, out = self.opened(), self.folder()
        check_networks(self, chosen)
        rows = compare_presets(self, chosen, dataset, out)
        if self.json:
            print_json(rows)
        else:
            print_tables(dataset.name, rows)
        write_tables(rows, out)
