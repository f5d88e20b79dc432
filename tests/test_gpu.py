"""The device: kernels compiled and launched as everywhere, on the CPU."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cuda_on_cpu import EmulatedDevice
from seepast.gpu import device


@pytest.fixture(autouse=True)
def emulated():
    with device.use(EmulatedDevice()) as found:
        yield found


def trial(count=150, factor=2.5):
    values = np.arange(count, dtype=np.int32) ** 2 - 70
    out, total = np.zeros(count, np.float32), np.zeros(1, np.int32)
    device.current().launch(
        "trial", "trial", grid=(-(-count // 64),), block=(64,), shared=4 * 64,
        args=[values, np.int32(count), np.float32(factor), out, total],
    )  # fmt: skip
    return values, out, total


@pytest.mark.parametrize("backwards", [False, True])
def test_barriers_shuffles_atomics_and_shared_memory(emulated, backwards):
    emulated.backwards = backwards
    values, out, total = trial()
    sums = np.repeat([block.sum() for block in np.split(values, [64, 128])], 64)[:150]
    assert np.array_equal(out, (np.float32(2.5) * values + sums).astype(np.float32))
    assert total[0] == values.sum()


@pytest.mark.parametrize("wrong", [np.float64(1), 1.0, np.int32(1), np.ones(1, np.float32)], ids=repr)
def test_an_argument_of_another_type_is_refused(wrong):
    some = np.zeros(1, np.int32)
    args = [some, np.int32(1), wrong, np.zeros(1, np.float32), some]
    with pytest.raises(AssertionError, match="argument 2"):
        device.current().launch("trial", "trial", grid=(1,), block=(64,), shared=256, args=args)


def test_threads_that_miss_a_barrier_are_found(tmp_path):
    (tmp_path / "stuck.cu").write_text(
        '#include "device.h"\nextern "C" __global__ void stuck(int n) {\n  if (threadIdx.x < n) __syncthreads();\n}\n'
    )
    stuck = {"file": str(tmp_path / "stuck"), "kernel": "stuck", "grid": (2,), "block": (8,)}
    device.current().launch(**stuck, args=[np.int32(8)])
    with pytest.raises(AssertionError, match="wait for others that do not come"):
        device.current().launch(**stuck, args=[np.int32(7)])
    device.current().launch(**stuck, args=[np.int32(8)])


def test_memory_ends_where_an_array_does(tmp_path):
    """In a process of its own, which falls."""
    (tmp_path / "past.cu").write_text(
        '#include "device.h"\nextern "C" __global__ void past(int* a, int n) { a[n + 3] = 1; }\n'
    )
    program = (
        "import numpy as np; from cuda_on_cpu import StrictDevice; d = StrictDevice(); a = d.xp.zeros(64, np.int32);"
        f"d.launch({str(tmp_path / 'past')!r}, 'past', grid=(1,), block=(1,), args=[a, np.int32(COUNT)])"
    )
    run = [sys.executable, "-c"]
    here = {"cwd": Path(__file__).parent, "capture_output": True}
    assert subprocess.run([*run, program.replace("COUNT", "60")], **here).returncode == 0
    assert subprocess.run([*run, program.replace("COUNT", "64")], **here).returncode == -signal.SIGSEGV
