"""Is the lock of a store free?"""

from pathlib import Path

from pipeline.base.disk import writing
from pipeline.base.errors import StoreError


def is_free(processed: Path) -> bool:
    try:
        with writing(processed, 0):
            return True
    except StoreError:
        return False
