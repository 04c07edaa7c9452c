"""Options of commands that read logs without a profile. Each option names a column with its unit, or a constant.

The options are converted to an ordinary profile (`pipeline.shell.profile.columns`), which replaces ``--profile``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pipeline.base.errors import UsageError
from pipeline.base.paths import check_output
from pipeline.shell import console
from pipeline.shell.commands.options import ProfileFile
from pipeline.shell.console import option

if TYPE_CHECKING:
    from pipeline.profiles.profile_model import Profile

Text = str | None

_STATED: dict[str, object] = {
    "time": Annotated[Text, option("--time", "Column of time with its unit, t:ms, or the time between rows, '1 ms'.")],
    "command": Annotated[Text, option("--command", "Column of the command with its unit: N, Nm, V, A, counts, %.")],
    "position": Annotated[Text, option("--position", "Column of the position with its unit; -x:mm reverses the sign.")],
    "force": Annotated[Text, option("--force", "Column of the measured force with its unit, f:N.")],
    "stiffness": Annotated[Text, option("--stiffness", "K of the wall: a column K:N/mm, or '2 N/mm'.")],
    "damping": Annotated[Text, option("--damping", "B of the wall: a column B:Ns/m, or '5 Ns/m'.")],
    "step": Annotated[Text, option("--step", "External step: a column F0:N, or '4 N'.")],
    "kind": Annotated[Text, option("--kind", "Cause of the motion: step, release, hit, free or staircase.")],
    "period": Annotated[Text, option("--period", "Sampling period, '1 ms' (default: from the time stamps).")],
    "gain": Annotated[Text, option("--gain", "Gain of the drive (force per unit of the command), '2.3 N/V'.")],
    "device": Annotated[Text, option("--device", "Name of the device of the logs.")],
    "experiment": Annotated[Text, option("--experiment", "Name of the experiment (default: 1).", "-e")],
}
_SHEET = Annotated[Path | None, option("--sheet", "Sheet with one row per log: .csv, .xlsx, .ods.")]
_SAVE = Annotated[Path | None, option("--save-profile", "Write the options as a profile (.toml).")]


def reads_logs(paths: str, *, walls: bool = True) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that adds the options for columns to a command with a parameter ``profile``.

    Parameters
    ----------
    paths : str
        Name of the parameter of the command that contains the logs.
    walls : bool
        As for `stated_profile`.
    """

    def decorate(work: Callable[..., Any]) -> Callable[..., Any]:
        signature = inspect.signature(work, eval_str=True)
        own = {name: how for name, how in _STATED.items() if name not in signature.parameters}

        @wraps(work)
        def run(sheet: Path | None = None, save_profile: Path | None = None, **given: Any) -> Any:
            texts: dict[str, Text] = {name: given.pop(name, None) for name in own}
            texts["sheet"] = None if sheet is None else str(sheet)
            if save_profile is not None or any(text is not None for text in texts.values()):
                logs = given[paths] if isinstance(given[paths], list) else [given[paths]]
                given["profile"] = _stated(texts, logs, given.get("profile"), save_profile, walls)
            return work(**given)

        parameters = [
            parameter.replace(annotation=ProfileFile) if name == "profile" else parameter
            for name, parameter in signature.parameters.items()
        ]
        kind = inspect.Parameter.KEYWORD_ONLY
        more = [inspect.Parameter(name, kind, default=None, annotation=how) for name, how in own.items()]
        more.append(inspect.Parameter("sheet", kind, default=None, annotation=_SHEET))
        more.append(inspect.Parameter("save_profile", kind, default=None, annotation=_SAVE))
        run.__signature__ = signature.replace(parameters=[*parameters, *more])  # type: ignore[attr-defined]
        return run

    return decorate


def _stated(texts: dict[str, Text], logs: list[Path], profile: Text, save: Path | None, walls: bool) -> Profile:
    """Return the profile that the options define, and print the evidence from the logs."""
    from pipeline.base.disk import write_text
    from pipeline.profiles.profile_files import load_profile
    from pipeline.profiles.profile_model import Sheet
    from pipeline.profiles.profile_text import profile_toml
    from pipeline.shell.profile.columns import StatedColumns, stated_profile

    if (
        profile is not None
        and texts["sheet"] is not None
        and save is None
        and not any(text for name, text in texts.items() if name != "sheet")
    ):
        loaded = load_profile(profile)
        return loaded.model_copy(update={"sheet": Sheet(file=texts["sheet"])})
    if profile is not None:
        named = next((f"--{name}" for name, text in texts.items() if text is not None), "--save-profile")
        raise UsageError(f"{named} cannot be combined with --profile, which names the columns. Give one of them.")
    if save is not None:
        check_output(save, "--save-profile")
        if save.exists():
            raise UsageError(f"--save-profile {save}: already exists. Name another file, or remove this one.")
    made, evidence = stated_profile(StatedColumns(**texts), logs, walls=walls)
    for line in evidence:
        console.step(line)
    if save is not None:
        write_text(save, profile_toml(made, evidence, save.parent))
        console.step(f"wrote {save}")
    return made
