"""What DART prints on stderr while it runs, caught."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from types import TracebackType

__all__ = ["CaughtWarnings"]


class CaughtWarnings:
    """Sends the process's stderr to a file in a `with` block, so that C++ output is seen too."""

    def __enter__(self) -> CaughtWarnings:
        sys.stderr.flush()
        self._saved = os.dup(2)
        self._file = tempfile.TemporaryFile()
        os.dup2(self._file.fileno(), 2)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.dup2(self._saved, 2)
        os.close(self._saved)
        self._file.close()

    def size(self) -> int:
        """Number of bytes printed so far."""
        return os.fstat(self._file.fileno()).st_size

    def first_since(self, size: int) -> str:
        """Give the first line printed after so many bytes, without its colours."""
        line = os.pread(self._file.fileno(), 400, size).decode(errors="replace").partition("\n")[0]
        return re.sub(r"\x1b\[[0-9;]*m", "", line).strip()
