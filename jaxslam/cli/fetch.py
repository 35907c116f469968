"""Download an entry of a catalog, with a progress bar."""

from collections.abc import Callable
from pathlib import Path

from rich.progress import Progress

from jaxslam.config.catalog import CatalogEntry
from jaxslam.io.download import download


def fetch(
    entry: CatalogEntry,
    url: str,
    target: Path,
    progress: Progress,
    *,
    title: str,
    require_space: Callable[[int, int], None] | None = None,
) -> None:
    """Download the file of an entry, and check its size and SHA-256 if the catalog has them.

    Args:
        entry: Entry of the catalog.
        url: Address of the file.
        target: File to write. An interrupted download is continued from `TARGET.part`.
        progress: Display that gets a bar for the download.
        title: Text before the bar.
        require_space: Function that raises an error if the disk has no space for the file. It is called once, with the
            bytes that are there and the bytes of the whole file, as soon as the size is known.

    Raises:
        DownloadError: If the file cannot be downloaded or written, or differs from the catalog.
    """
    task = progress.add_task(title, total=entry.size_bytes)
    checked = False

    def show(done: int, total: int | None) -> None:
        nonlocal checked
        if require_space is not None and total is not None and not checked:
            checked = True
            require_space(done, total)
        progress.update(task, completed=done, total=total)

    if entry.size_bytes is not None:
        part = target.with_name(f"{target.name}.part")
        show(part.stat().st_size if part.is_file() else 0, entry.size_bytes)
    download(url, target, sha256=entry.sha256, size=entry.size_bytes, progress=show)
