"""What the assembler says about kernels: registers, shared memory, and what it had to spill."""

from __future__ import annotations

import re
from dataclasses import dataclass

_ENTRY = re.compile(r"Compiling entry function '(\w+)'")
_MEMORY = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
_USED = re.compile(r"Used (\d+) registers(?:.*?(\d+) bytes smem)?")


@dataclass(frozen=True)
class Usage:
    """Of one thread: registers, bytes of stack, bytes spilled (stored and loaded); of a block: bytes of shared memory
    beside what the launch asks for."""

    registers: int
    stack: int
    spilled: int
    shared: int


def usage(log: str) -> dict[str, Usage]:
    """By kernel, from a log of compiling with --ptxas-options=-v."""
    found: dict[str, Usage] = {}
    kernel, stack, spilled = "", 0, 0
    for line in log.splitlines():
        if entry := _ENTRY.search(line):
            kernel, stack, spilled = entry[1], 0, 0
        elif memory := _MEMORY.search(line):
            stack, stores, loads = map(int, memory.groups())
            spilled = stores + loads
        elif used := _USED.search(line):
            if kernel:
                found[kernel] = Usage(int(used[1]), stack, spilled, int(used[2] or 0))
            kernel = ""
    return found
