"""python -m dnddpg_minimal.plots notebooks/NN_name.ipynb: a chapter's last figure.

It is written to `notebooks/figures/NN_name.png`, which the chapter shows at its top.
"""

import base64
import json
import sys
from pathlib import Path


def save_last_figure(notebook):
    """Write the last figure of an executed notebook beside it, → the file's path."""
    notebook = Path(notebook)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    figures = [output["data"]["image/png"] for cell in cells
               for output in cell.get("outputs", [])
               if "image/png" in output.get("data", {})]
    if not figures:
        raise ValueError(f"{notebook} holds no figure: run it first.")
    path = notebook.parent / "figures" / f"{notebook.stem}.png"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(base64.b64decode("".join(figures[-1])))
    return path


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(save_last_figure(argument))
