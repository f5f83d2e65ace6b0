"""Time of a piece of work on the processor or on a GPU."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from mbds_xsim.errors import InputError
from mbds_xsim.learn.device import check_device

__all__ = ["add_device", "chosen_device", "machine_of", "spent"]


def add_device(parser: argparse.ArgumentParser) -> None:
    """Let a benchmark be asked for a GPU."""
    parser.add_argument("--device", default="cpu", help="cpu or cuda")


def chosen_device(parser: argparse.ArgumentParser, asked: str) -> str:
    """Give the device that was asked for; end with one line where there is none."""
    try:
        check_device(asked)
    except InputError as error:
        parser.error(str(error))
    return asked


def machine_of(device: str, machine: str) -> str:
    """Name what work was timed on."""
    return machine if device == "cpu" else f"{torch.cuda.get_device_name()}, {machine}"


def spent(work: Callable[[], object], device: str = "cpu") -> float:
    """Time of one thread of the processor, or on a GPU until all is done [s]."""
    if device == "cpu":
        begin = time.process_time()
        work()
        return time.process_time() - begin
    torch.cuda.synchronize()
    begin = time.perf_counter()
    work()
    torch.cuda.synchronize()
    return time.perf_counter() - begin
