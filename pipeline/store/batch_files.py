"""A batch on disk: one file of samples and one of trials, of the same name; the second makes the first visible.

Names are ``<number>-<hash of the trials>.parquet``. Numbers rise, so that of two versions of a trial the one with the
higher number is the newer, whatever the clocks of the machines that recorded them say.

Each of the two files carries, in the annex of its seal, what is needed where the other is damaged: the samples file the
whole trials file, the trials file the footer of the samples file, without which none of its groups can be read.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.base.disk import NewFile, publish_all, remove, sync_folder
from pipeline.base.provenance import digest, stamp
from pipeline.base.seal import read_annex, sealed
from pipeline.records.models import Motion
from pipeline.records.table_files import SealedWriter, parquet_bytes
from pipeline.records.tables import arrow_schema, to_arrow
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
        self._writer = SealedWriter(self._file.stream, self._schema)

    def write(self, samples: pa.Table) -> None:
        """Append samples as one group; the table has the columns of the stored one."""
        if samples.num_rows:
            self._writer.write(samples, samples.num_rows)
            self.rows += samples.num_rows

    def publish(self, trials: Mapping[str, Sequence[Any] | pa.ChunkedArray], number: int, mark: str = "") -> Path:
        """Make the batch visible and return its trials file.

        Parameters
        ----------
        trials : mapping of str to column
            All columns of the trials table but ``sample_file``.
        number : int
            Its number, above that of all visible batches (`next_number`).
        mark : str, optional
            Put before the hash: a batch that stands for a damaged one keeps its number and needs another name.
        """
        self.finish(trials, number, mark)
        publish_batches([self])
        return self.trials_file

    def finish(self, trials: Mapping[str, Sequence[Any] | pa.ChunkedArray], number: int, mark: str = "") -> None:
        """Write all that is left, for `publish_batches`; takes what `publish` takes."""
        identity = zip(*(_values(trials[name]) for name in ("source_path", "trial_id", "profile_sha256")), strict=True)
        self.name = f"{number:06d}-{mark}{digest(sorted(identity))}.parquet"
        path = samples_folder(self.processed, self.device, self.experiment) / self.name
        file = path.relative_to(self.processed).as_posix()
        columns = {**trials, "sample_file": [file] * len(trials["trial_id"])}
        metadata = stamp(device=self.device, experiment=self.experiment)
        table = parquet_bytes(to_arrow("trials", columns, rotation=self.rotation, metadata=metadata))
        footer = self._writer.close(pack_annex(table))
        self._trials = NewFile(self.trials_file.parent, self.name)
        self._trials.stream.write(sealed(table, pack_annex(footer)))

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
        self._writer.__exit__()
        self._file.discard()
        if self._trials is not None:
            self._trials.discard()


def publish_batches(batches: Sequence[NewBatch]) -> None:
    """Make finished batches visible: the samples of all are on the disk before any trial is seen."""
    files = [(batch.files(), batch.name) for batch in batches]
    publish_all([(samples, name) for (samples, _), name in files], [(trials, name) for (_, trials), name in files])


def trials_copy(samples: Path) -> pa.Table | None:
    """Return the trials that a samples file was written with, None where it has no copy that can be read."""
    data = trials_bytes(samples.read_bytes())
    return None if data is None else pq.read_table(io.BytesIO(data), schema=arrow_schema("trials"))


def trials_bytes(samples: bytes) -> bytes | None:
    """Return the trials file, but for its seal, out of a samples file; None where it has none that can be read."""
    return _unpacked(read_annex(io.BytesIO(samples)))


def samples_footer(trials: bytes) -> bytes | None:
    """Return the footer of the samples file out of a trials file; None where it has none that can be read."""
    return _unpacked(read_annex(io.BytesIO(trials)))


def pack_annex(content: bytes) -> bytes:
    """Return the annex by which a file of a batch carries a part of the other."""
    return zlib.compress(content)


def _unpacked(annex: bytes) -> bytes | None:
    # zlib has a checksum of its own
    with suppress(zlib.error):
        return zlib.decompress(annex)
    return None


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
