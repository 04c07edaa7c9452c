"""Decide which action an ingest takes for a source, given the source and the stored data.

The functions are pure and access no files. `decide_unread` uses size and time of a source before it is opened. `decide`
uses the content. Each rule has a name, and the first rule that applies determines the decision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pipeline.base.errors import LogError
from pipeline.base.paths import path_of_text
from pipeline.base.wording import counted
from pipeline.intake.quarantine import QuarantineRecord
from pipeline.intake.sources import Source
from pipeline.intake.stored_sources import StoredSource

Rule = Literal[
    "unchanged", "copy", "renamed copy", "new", "renamed", "changed", "profile changed", "completed", "refused before"
]
"""Names of the rules.

"copy": a different stored source has the same content. "renamed copy": a copy whose name states different conditions.
"completed": an interrupted run had stored only some of the trials.
"""


@dataclass(frozen=True)
class Twin:
    """A stored source with a different path, but the same content, and the same conditions in its name."""

    path: str
    stored: StoredSource
    exists: bool

    @property
    def name(self) -> str:
        """Name of the file."""
        return path_of_text(self.path).name


@dataclass(frozen=True)
class Evidence:
    """A source with its content, and the stored sources that it may repeat or replace.

    Parameters
    ----------
    source : Source
    sha256 : str
        Hash of its content.
    devices : tuple of str or None
        Devices of its trials. None if it was not parsed because its content is already stored.
    former : StoredSource or None
        Stored source with the same path.
    twin : Twin or None
    lost : tuple of (str, StoredSource) or None
        Path and data of a stored source with the same content and profile whose file no longer exists. Set only if the
        profile reads conditions from names, so that a source with a corrected name is not treated as a copy.
    """

    source: Source
    sha256: str
    devices: tuple[str, ...] | None = None
    former: StoredSource | None = None
    twin: Twin | None = None
    lost: tuple[str, StoredSource] | None = None

    @property
    def is_same(self) -> bool:
        """True if the same content is stored under the same path."""
        return self.former is not None and self.former.sha256 == self.sha256


@dataclass(frozen=True)
class Drop:
    """Removal of the trials of a source that is stored under ``path``.

    ``outcome`` is reported for the source ``shown``. With None, no outcome is reported. If ``late`` is true, the trials
    are removed after the new trials are stored.
    """

    shown: str
    path: str
    stored: StoredSource
    outcome: str | None = None
    late: bool = False


@dataclass(frozen=True)
class Decision:
    """Decision on a source: the rule, the reason for the report, removals, and a warning."""

    rule: Rule
    reason: str
    drops: tuple[Drop, ...] = ()
    warning: str | None = None

    @property
    def stores(self) -> bool:
        """True if the trials of the source are stored."""
        return self.rule in ("new", "renamed", "changed", "profile changed", "completed")


def decide_unread(
    source: Source, stored: StoredSource | None, refused: QuarantineRecord | None, *, replace: bool
) -> Decision | None:
    """Return the decision on a source by size, time and profile, or None if its content must be read.

    A refused source without a hash could not be read. Such a source is tried again, because new permissions change
    neither size nor time. With ``replace``, other refused sources are also tried again.

    Parameters
    ----------
    source : Source
    stored : StoredSource or None
        Stored source with the same path.
    refused : QuarantineRecord or None
        Record of the source in quarantine.
    replace : bool
        True if trials read with a different profile or for a different device are replaced.
    """
    state = (source.size, source.mtime_ns, source.profile_sha256)
    former = None if refused is None else (refused.size, refused.mtime_ns, refused.profile_sha256)
    if refused is not None and state == former and refused.sha256 is not None and not replace:
        return Decision("refused before", refused.reason)
    if stored is not None and stored.whole and state == (stored.size, stored.mtime_ns, stored.profile_sha256):
        return Decision("unchanged", "unchanged: size and modification time")
    return None


def decide(evidence: Evidence, *, replace: bool) -> Decision:
    """Return the decision on a source whose content has been read.

    Parameters
    ----------
    evidence : Evidence
    replace : bool
        True to replace trials with the same content that were read with a different profile or for a different device.

    Raises
    ------
    LogError
        If such trials exist and ``replace`` is false.
    """
    twin, former = evidence.twin, evidence.former
    if evidence.devices is None or (twin is not None and twin.stored.profile_sha256 == evidence.source.profile_sha256):
        return _repeated(evidence)
    rival = former if evidence.is_same else twin.stored if twin is not None else None
    replaced = _replaced_rival(evidence, rival, replace=replace)
    if twin is not None and replaced is None and twin.exists:  # read with a different version of the profile
        return _repeated(evidence)
    shown, key = evidence.source.shown, evidence.source.key
    drops = () if twin is None else (Drop(shown, twin.path, twin.stored, replaced),)
    if former is None:
        return _new(evidence, drops)
    if not evidence.is_same:
        outcome = "its trials were replaced by the trials of the new content"
        late = evidence.source.mtime_ns > former.mtime_ns
        return Decision("changed", "content changed", (*drops, Drop(shown, key, former, outcome, late)))
    if former.profile_sha256 != evidence.source.profile_sha256:
        return Decision("profile changed", "profile changed", (*drops, Drop(shown, key, former, replaced)))
    return Decision("completed", "stored only in part by an interrupted run", drops)


def _repeated(evidence: Evidence) -> Decision:
    """Return the decision on a source whose content is stored, under the same or a different path."""
    source, twin, former = evidence.source, evidence.twin, evidence.former
    if twin is None:
        return Decision("unchanged", "unchanged content")
    drops: tuple[Drop, ...] = ()
    if former is not None:
        outcome = f"it now has the content of {twin.path}; its former trials were removed"
        if evidence.is_same:
            outcome = f"{twin.path} now has the same content, and the trials are stored for that log"
        drops = (Drop(source.shown, source.key, former, outcome),)
    reason = f"same content as {twin.path}"
    if source.profile is not None and source.profile.reads_names and twin.name != source.path.name:
        text = f"has the content of {twin.path} under a different name and was skipped. Remove the wrong file."
        return Decision("renamed copy", reason, drops, text)
    return Decision("copy", reason, drops)


def _new(evidence: Evidence, drops: tuple[Drop, ...]) -> Decision:
    """Return the decision on a source whose path is not stored.

    The source is new, or is a lost source with a corrected name.
    """
    source = evidence.source
    if evidence.lost is None:
        return Decision("new", "new", drops)
    path, stored = evidence.lost
    lost = Drop(path, path, stored, f"was renamed to {source.shown}; its trials were read again")
    return Decision("renamed", f"its name was {path}", (*drops, lost))


def _replaced_rival(evidence: Evidence, rival: StoredSource | None, *, replace: bool) -> str | None:
    """Return the report text on stored trials with the content of this source that it replaces, or None if there are
    none. Such trials were read with a different profile or for a different device.

    Raises
    ------
    LogError
        If there are such trials and ``replace`` is false.
    """
    assert evidence.source.profile is not None, "a source without a profile is refused before it is read"
    profile, devices = evidence.source.profile.name, sorted(set(evidence.devices or ()))
    if rival is None or (rival.profile, sorted(set(rival.devices))) == (profile, devices):
        return None
    before = f"device {', '.join(map(repr, sorted(set(rival.devices))))} by profile {rival.profile!r}"
    if not replace:
        raise LogError(
            f"is stored as a log of {before}, but profile {profile!r} now claims it for device "
            f"{', '.join(map(repr, devices))}. The stored trials were not changed. To read the log with the new "
            "profile, delete the stored trials or use --replace. Otherwise, select the right profile with --profile.",
            code="profile-wrong",
        )
    count = len(rival.trials)
    return f"{counted(count, 'trial')} of {before} {'was' if count == 1 else 'were'} replaced"
