"""What the site shows, where it stands in the repository: links work there and here alike."""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

_SHOWN = (
    "README.md",
    "CONTRIBUTING.md",
    "docs/**/*",
    "reports/**/*",
    "scenes/**/*.toml",
    "mbds_xsim/**/*.py",
    "mbds_xsim/**/*.toml",
    "adapters/**/*.py",
    "tests/scene/mechanisms/*.toml",
)
_KINDS = {".md", ".png", ".csv", ".json", ".gz", ".toml", ".py"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Take the pages from the whole repository; keep what the theme brings."""
    root = Path(config.config_file_path).parent
    shown = (path for pattern in _SHOWN for path in sorted(root.glob(pattern)))
    kept = [file for file in files if not file.src_uri.endswith(tuple(_KINDS))]
    return Files(
        kept
        + [
            File.generated(config, path.relative_to(root).as_posix(), abs_src_path=str(path))
            for path in shown
            if path.suffix in _KINDS
        ]
    )
