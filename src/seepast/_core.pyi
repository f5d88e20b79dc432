"""The C++ core (cpp/bindings.cpp); backends/cpu.py gives its functions their shapes."""

from typing import Any

def __getattr__(name: str) -> Any: ...
