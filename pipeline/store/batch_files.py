"""A batch on disk: one file of samples and one of trials, of the same name; the second makes the first visible.

Names are ``<number>-<hash of the trials>.parquet``. Numbers rise, so that of two versions of a trial the one with the
higher number is the newer, whatever the clocks of the machines that recorded them say.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import NewFile, publish_all, remove, sync_folder
from pipeline.base.provenance import digest, stamp
from pipeline.records.models import Motion
from pipeline.records.tables import WRITING, arrow_schema, new_table, to_arrow
from pipeline.store.storage import batch_number, samples_folder, trials_files, trials_folder


class NewBatch:
    """A batch of one device, experiment and motion that grows group by group and is then made visible.

    Parameters
    ----------
    processed : Path
    device, experiment : str
    motion : {"translation", "rotation"}
    """

    def __init__(self, processed: Path, device: str, experiment: str, motion: Motion) -> None:
        self.processed, self.device, self.experiment = processed, device, experiment
        self.rotation = motion == "rotation"
        self.rows = 0
        self.name = ""
        self._trials: NewFile | None = None
        metadata = stamp(device=device, experiment=experiment)
        self._schema = arrow_schema("samples", rotation=self.rotation, metadata=metadata)
        self._file = NewFile(samples_folder(processed, device, experiment), f"samples-{motion}")
        self._writer = pq.ParquetWriter(self._file.stream, self._schema, **WRITING)

    def write(self, samples: pa.Table) -> None:
        """Append samples as one group; the table has the columns of the stored one."""
        if samples.num_rows:
            self._writer.write_table(samples, row_group_size=samples.num_rows)
            self.rows += samples.num_rows

    def publish(self, trials: Mapping[str, Sequence[Any] | pa.ChunkedArray], number: int) -> Path:
        """Make the batch visible and return its trials file.

        Parameters
        ----------
        trials : mapping of str to column
            All columns of the trials table but ``sample_file``.
        number : int
            Its number, above that of all visible batches (`next_number`).
        """
        self.finish(trials, number)
        publish_batches([self])
        return self.trials_file

    def finish(self, trials: Mapping[str, Sequence[Any] | pa.ChunkedArray], number: int) -> None:
        """Write all that is left, for `publish_batches`; takes what `publish` takes."""
        identity = zip(*(_values(trials[name]) for name in ("source_path", "trial_id", "profile_sha256")), strict=True)
        self.name = f"{number:06d}-{digest(sorted(identity))}.parquet"
        self._writer.close()
        path = samples_folder(self.processed, self.device, self.experiment) / self.name
        file = path.relative_to(self.processed).as_posix()
        columns = {**trials, "sample_file": [file] * len(trials["trial_id"])}
        metadata = stamp(device=self.device, experiment=self.experiment)
        self._trials = new_table(
            self.trials_file, to_arrow("trials", columns, rotation=self.rotation, metadata=metadata)
        )

    @property
    def trials_file(self) -> Path:
        """Where its trials will be seen."""
        return trials_folder(self.processed, self.device, self.experiment) / self.name

    def files(self) -> tuple[NewFile, NewFile]:
        """Return its files of samples and of trials, when it is finished."""
        assert self._trials is not None, "a batch is finished before it is published"
        return self._file, self._trials

    def discard(self) -> None:
        """Remove what was written, if it was not made visible."""
        # the end of a file that nobody wants; on a full disk it cannot be written
        with suppress(OSError, ValueError, pa.ArrowException):
            self._writer.close()
        self._file.discard()
        if self._trials is not None:
            self._trials.discard()


def publish_batches(batches: Sequence[NewBatch]) -> None:
    """Make finished batches visible: the samples of all are on the disk before any trial is seen."""
    files = [(batch.files(), batch.name) for batch in batches]
    publish_all([(samples, name) for (samples, _), name in files], [(trials, name) for (_, trials), name in files])


def _values(column: Sequence[Any] | pa.ChunkedArray) -> Sequence[Any]:
    values: Sequence[Any] = column.to_pylist() if isinstance(column, pa.ChunkedArray) else column
    return values


def next_number(processed: Path) -> int:
    """Return the number of a new batch, above that of all visible ones."""
    return max((batch_number(file) for file in trials_files(processed)), default=0) + 1


def remove_batches(processed: Path, trials: Iterable[Path]) -> None:
    """Remove trials files, then the samples files of the same name.

    The removal of the first is on the disk before that of the second begins: no trial ever names samples that are gone.
    """
    files = list(trials)
    for file in files:
        remove(file)
    for folder in sorted({file.parent for file in files}):
        sync_folder(folder)
    samples = [processed / "samples" / file.relative_to(processed / "trials") for file in files]
    for file in samples:
        remove(file)
    for folder in sorted({file.parent for file in samples if file.parent.is_dir()}):
        sync_folder(folder)
