"""A rendered room whose frames are kept in files, for those who track it several times."""

from pathlib import Path

from jaxslam.datasets.synthetic.dataset import SyntheticConfig, SyntheticDataset, SyntheticFrame
from jaxslam.datasets.synthetic.frame_files import FrameFiles, arrays_of


class StoredRoom(SyntheticDataset):
    """The same frames as `SyntheticDataset`, each rendered once, by whichever process asks for it first.

    Rendering takes 0.1 s a frame of 640x480 pixels, and reading one of 4.6 MB 2 ms. Processes may share a folder.

    Args:
        config: Settings of the recording.
        folder: Folder of the frames, for this room alone; created if it does not exist.
    """

    def __init__(self, config: SyntheticConfig, folder: Path) -> None:
        super().__init__(config)
        self._files = FrameFiles(folder)

    def render(self, index: int) -> SyntheticFrame:
        """Frame `index` with its ground truth.

        Raises:
            IndexError: If there is no such frame.
            DatasetError: If it cannot be kept.
        """
        index = range(len(self))[index]
        arrays = self._files.read(index)
        if arrays is not None:
            return SyntheticFrame(int(self.timestamps_ns[index]), **arrays)
        frame = super().render(index)
        self._files.write(index, arrays_of(frame))
        return frame

    def render_all(self) -> None:
        """Render what is not there yet, so that no time taken later is that of rendering."""
        for index in range(len(self)):
            if not self._files.has(index):
                self.render(index)
