"""Bytes of a data file: h5py reads them, and they are written without copies."""

from __future__ import annotations

import io

import h5py
import numpy as np

from mbds_xsim.dataset.encoding import encode
from mbds_xsim.dataset.layout import FIELDS

ROWS = np.random.default_rng(0).normal(size=(5, 4, 2, 3))
DATASETS = {
    "body/position": ROWS,
    "position": ROWS,
    "index": np.arange(5),
    "input/torque": np.zeros((5, 3, 0)),
    "graph/body_name": np.array(["rod", "Stäbe"]),
    "valid_in_all": np.array([True, False]),
}


def test_the_library_reads_what_was_given() -> None:
    with h5py.File(io.BytesIO(b"".join(encode(DATASETS, {"seed": 3})))) as file:
        assert file.attrs["seed"] == 3
        for name, given in DATASETS.items():
            dataset = file[name]
            text = h5py.check_string_dtype(dataset.dtype) is not None
            stored = dataset.asstr()[()] if text else dataset[()]
            rounded = given if text else given.astype(FIELDS[name].dtype)
            assert stored.dtype == (object if text else rounded.dtype)
            assert np.array_equal(stored, rounded)
        rounding = np.abs(ROWS.astype("<f4") - ROWS).max()
        assert file["position"].attrs["largest_rounding"] == rounding


def test_values_are_not_copied() -> None:
    pieces = map(np.frombuffer, encode(DATASETS, {}), [np.uint8] * 99)

    assert sum(np.shares_memory(piece, ROWS) for piece in pieces) == 1
