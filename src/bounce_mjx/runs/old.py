"""Reading of checkpoints that version 0.1 wrote: `checkpoints/best/<steps>/` and `latest/<steps>/`,
with run.json, and arrays of one chunk in OCDBT and zarr without orbax's own metadata."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

RECORD_FILE = "run.json"


def is_old(folder: Path) -> bool:
    """Whether version 0.1 wrote a checkpoint."""
    return (folder / RECORD_FILE).is_file()


def stored(checkpoints: Path, name: str) -> list[Path]:
    """The checkpoints in a run's folder of checkpoints with the name "best" or "latest"."""
    return [path for path in checkpoints.glob(f"{name}/*") if path.name.isdecimal()]


def read_arrays(folder: Path, template: Any) -> Any:
    """Reads an item; raises ValueError if it is not as `template`."""
    import tensorstore

    def read(path: tuple, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        files = {"driver": "file", "path": f"{folder}/"}
        database = {"driver": "ocdbt", "base": files, "path": f"{name}/"}
        form = {"shape": leaf.shape, "chunks": leaf.shape, "dtype": leaf.dtype.str}
        spec = {"driver": "zarr", "kvstore": database, "metadata": form}
        return tensorstore.open(spec, open=True, read=True).result().read().result()

    return jax.tree_util.tree_map_with_path(read, template)
