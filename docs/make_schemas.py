"""Write the JSON Schemas in ``schemas/`` from the records in `pipeline.records.models`; run by ``make docs``."""

from __future__ import annotations

import json
from pathlib import Path

from pipeline.records.models import SCHEMA_MODELS

FOLDER = Path(__file__).parents[1] / "schemas"


def schemas() -> dict[str, str]:
    """Return the text of each schema file by its name (`device.json`, ...).

    Fields are named as in the files that users write (TOML, JSON); keys are sorted, so that equal records
    give equal files.
    """
    return {
        f"{name}.json": json.dumps(model.model_json_schema(by_alias=True), indent=2, sort_keys=True) + "\n"
        for name, model in sorted(SCHEMA_MODELS.items())
    }


def main() -> None:
    """Write all schema files and remove those of records that no longer exist."""
    texts = schemas()
    for old in FOLDER.glob("*.json"):
        if old.name not in texts:
            old.unlink()
    for name, text in texts.items():
        (FOLDER / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
