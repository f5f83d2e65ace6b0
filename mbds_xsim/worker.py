"""The process that carries out one task of `mbds_xsim.isolate`: reads it, writes the answer."""

from __future__ import annotations

import os
import pickle
import sys
import traceback
from pathlib import Path

from mbds_xsim.errors import InputError


def _main(task_path: Path, answer_path: Path) -> None:
    function, arguments = pickle.loads(task_path.read_bytes())
    try:
        answer: tuple[str, object] = ("done", function(*arguments))
    except InputError as error:
        answer = ("input error", str(error))
    except Exception:
        answer = ("raised", traceback.format_exc())
    partial = answer_path.with_suffix(".part")
    partial.write_bytes(pickle.dumps(answer, protocol=pickle.HIGHEST_PROTOCOL))
    os.replace(partial, answer_path)


if __name__ == "__main__":
    _main(Path(sys.argv[1]), Path(sys.argv[2]))
