"""Picture for the README: the page of a validation in a headless browser.

python benchmarks/page_picture.py out/3ladder docs/images/validate-3ladder.png

Reads the page and the JSON of one validation. The settings of its engines are written into the
picture, so that a test notices when they change. Needs Chromium or Chrome.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from mbds_xsim.base.files import write_whole
from mbds_xsim.measure.result import Validation, from_plain
from mbds_xsim.report.themed import SOURCE, few_colours

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIZE = (1240, 1760)


def main(base: str, target: str) -> None:
    stored = from_plain(msgspec.json.decode(Path(f"{base}.json").read_bytes()), Validation)
    metadata = PngInfo()
    lines = (settings_line(e.engine, e.method, e.step_s, e.options) for e in stored.engines)
    metadata.add_text(SOURCE, "\n".join(lines))
    with Image.open(io.BytesIO(_shot(Path(f"{base}.html")))) as shot:
        stream = io.BytesIO()
        few_colours(shot.convert("RGB")).save(stream, "png", optimize=True, pnginfo=metadata)
    write_whole(Path(target), stream.getvalue())


def settings_line(engine: str, method: str, step: float, options: Mapping[str, Any]) -> str:
    """Describe an engine's settings in one line."""
    return f"{engine} {method} {step:.9g} s {sorted(options.items())}"


def _shot(page: Path) -> bytes:
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit(f"no browser: install one of {', '.join(BROWSERS)}")
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        subprocess.run(
            [
                browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
                f"--user-data-dir={folder}/profile", "--virtual-time-budget=4000",
                f"--window-size={SIZE[0]},{SIZE[1]}", f"--screenshot={shot}",
                page.absolute().as_uri(),
            ],
            check=True,
            capture_output=True,
            timeout=120,
        )  # fmt: skip
        return shot.read_bytes()


if __name__ == "__main__":
    main(*sys.argv[1:])
