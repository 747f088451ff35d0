"""The pictures of the gallery, from the notebooks: ``python docs/thumbnails.py``."""

import base64
import io
import json
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
SHOWN = {"cross_entropy": 1, "heads": 1, "weakness": -1, "specifications": 1}
"""Which picture of a notebook, where it is not the first."""
SIZE = 340, 220


def thumbnail(notebook):
    cells = json.loads(notebook.read_text())["cells"]
    data = [o["data"] for cell in cells for o in cell.get("outputs", []) if "data" in o]
    pictures = [d["image/png"] for d in data if "image/png" in d]
    raw = base64.b64decode("".join(pictures[SHOWN.get(notebook.stem, 0)]))
    small = Image.open(io.BytesIO(raw)).convert("RGB")
    small.thumbnail(SIZE, Image.Resampling.LANCZOS)
    page = Image.new("RGB", SIZE, "white")
    page.paste(small, ((SIZE[0] - small.width) // 2, (SIZE[1] - small.height) // 2))
    page.quantize(64).save(HERE / f"thumbnails/{notebook.stem}.png", optimize=True)


if __name__ == "__main__":
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        thumbnail(notebook)
