"""Every kernel compiles for the GPUs that are promised and none spills registers; kept machine code; error messages."""

from __future__ import annotations

import logging
import re
import sys
from types import SimpleNamespace

import pytest

from cuda_on_cpu import KERNEL
from seepast import backends
from seepast.errors import BackendError, MissingExtraError
from seepast.gpu import cubins, device, nvrtc
from seepast.gpu.ptxas import Usage, usage

TURING, ORIN, HOPPER = 75, 87, 90
REGISTERS = 255  # of a thread


def compiler_or_skip(major: int) -> nvrtc.Compiler:
    try:
        return nvrtc.compiler(major)
    except BackendError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize(("architecture", "major"), [(TURING, 12), (ORIN, 12), (HOPPER, 12), (HOPPER, 13)])
@pytest.mark.parametrize("file", cubins.files())
def test_every_kernel_compiles_without_spilling(file: str, architecture: int, major: int) -> None:
    compiler_or_skip(major)
    code, log = cubins.compiled(file, architecture, major, "--ptxas-options=-v")
    kernels = KERNEL.findall((cubins.KERNELS / f"{file}.cu").read_text())
    found = usage(log)
    assert code[:4] == b"\x7fELF" and kernels and set(found) == set(kernels)
    for kernel, used in found.items():
        assert used.spilled == 0, f"{kernel}: {used}"
        assert 0 < used.registers <= REGISTERS


def test_spills_are_read_from_the_compilers_report() -> None:
    compiler = compiler_or_skip(12)
    source = """
    extern "C" __global__ void __launch_bounds__(1024, 2) many(const float* in, float* out, int n) {
      float v[64];
      for (int i = 0; i < 64; ++i) v[i] = in[threadIdx.x + 1024 * i];
      for (int k = 0; k < n; ++k)
        for (int i = 0; i < 64; ++i) v[i] = v[i] * v[(i + 7) % 64] + v[(i + 13) % 64];
      for (int i = 0; i < 64; ++i) out[threadIdx.x + 1024 * i] = v[i];
    }"""
    _, log = compiler.compile(source, "many.cu", {}, ["--gpu-architecture=sm_75", "--ptxas-options=-v"])
    assert usage(log)["many"].spilled > 0
    assert usage("ptxas info    : Compiling entry function 'a' for 'sm_90'\nptxas info    : Used 18 registers, used 1 "
                 "barriers, 16 bytes smem") == {"a": Usage(18, 0, 0, 16)}  # fmt: skip


def test_shared_headers_are_installed_with_the_kernels() -> None:
    cmake = (cubins.CHECKOUT.parent / "CMakeLists.txt").read_text()
    installed = re.search(r"install\(FILES ([^)]*) DESTINATION seepast/gpu/kernels\)", cmake)
    assert installed and installed[1].split() == [f"cpp/{name}" for name in cubins.SHARED]
    own = {path.name for path in cubins.KERNELS.glob("*.h")}
    assert not own & set(cubins.SHARED), "one name, one header"


def test_machine_code_is_kept_and_compiling_is_said_once(tmp_path, monkeypatch, caplog) -> None:
    compiler_or_skip(12)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cubins, "_said", False)
    with caplog.at_level(logging.INFO, "seepast"):
        first = cubins.cubin("trial", HOPPER, 12)
        other = cubins.cubin("trial", TURING, 12)
    assert first != other and len(list((tmp_path / "seepast" / "cubins").glob("trial-*.cubin"))) == 2
    assert [r.message for r in caplog.records] == [
        "compiling for a GPU of compute capability 9.0: seconds, and only this once"
    ]
    monkeypatch.setattr(cubins, "compiled", None)  # not needed any more
    assert cubins.cubin("trial", HOPPER, 12) == first


def test_what_is_missing_is_compiled_beforehand(tmp_path, monkeypatch) -> None:
    compiler_or_skip(12)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cubins, "files", lambda: ["trial", "masks"])
    cubins.cubin("trial", HOPPER, 12)
    kept = next(cubins.folder().iterdir()).stat().st_mtime_ns
    cubins.prepare(HOPPER, 12)
    found = {path.name.partition("-")[0]: path.stat().st_mtime_ns for path in cubins.folder().iterdir()}
    assert set(found) == {"trial", "masks"} and found["trial"] == kept


def test_another_header_is_another_machine_code(monkeypatch) -> None:
    compiler_or_skip(12)
    key = cubins._key("trial", HOPPER, 12)
    changed = {**cubins.headers(), "pixel.h": cubins.headers()["pixel.h"] + "// changed\n"}
    monkeypatch.setattr(cubins, "headers", lambda: changed)
    assert cubins._key("trial", HOPPER, 12) != key


def test_a_folder_that_cannot_be_written_is_no_fault(tmp_path, monkeypatch) -> None:
    compiler_or_skip(12)
    (tmp_path / "seepast").write_text("not a folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cubins.cubin("trial", HOPPER, 12)[:4] == b"\x7fELF"


def test_the_compilers_words_are_in_the_error() -> None:
    compiler = compiler_or_skip(12)
    with pytest.raises(BackendError, match=r"bad\.cu: CUDA 12.*undefined"):
        compiler.compile('extern "C" __global__ void bad() { nothing(); }', "bad.cu", {}, [])


# ------------------------------------------------------------------------------------------- no GPU, or none that works


class FakeError(RuntimeError):
    pass


def fake_cupy(driver: int, runtime: int = 12090, devices: int = 1) -> SimpleNamespace:
    def count() -> int:
        if not devices:
            raise FakeError("no CUDA-capable device is detected")
        return devices

    calls = SimpleNamespace(
        driverGetVersion=lambda: driver,
        runtimeGetVersion=lambda: runtime,
        getDeviceCount=count,
        CUDARuntimeError=FakeError,
    )
    return SimpleNamespace(cuda=SimpleNamespace(runtime=calls))


@pytest.fixture
def no_device_yet(monkeypatch):
    monkeypatch.setattr(device, "_found", None)
    monkeypatch.setattr(device, "_used", None)


FAULTS = {
    "no driver": (fake_cupy(0), "no NVIDIA driver"),
    "old driver": (fake_cupy(11080), r"knows CUDA 11\.8, CuPy is of CUDA 12: update the driver to 525"),
    "driver of CUDA 12, CuPy of 13": (fake_cupy(12040, 13000), r"update .* or pip install 'seepast\[cuda12\]'"),
    "no GPU": (fake_cupy(12090, devices=0), "cannot use the GPU .no CUDA-capable device"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_missing_is_said_and_auto_goes_on(name, monkeypatch, caplog, no_device_yet) -> None:
    cupy, message = FAULTS[name]
    monkeypatch.setitem(sys.modules, "cupy", cupy)
    with pytest.raises(BackendError, match=message):
        backends.get("cuda")
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: cupy)
    backends._fastest.cache_clear()
    with caplog.at_level(logging.WARNING, "seepast"):
        assert backends.get("auto") is backends.get("auto") is backends.get("cpu")
    backends._fastest.cache_clear()
    assert len(caplog.records) == 1 and "going on with --backend cpu" in caplog.text


def test_without_cupy_the_extra_is_named_and_auto_says_nothing(monkeypatch, caplog, no_device_yet) -> None:
    monkeypatch.setitem(sys.modules, "cupy", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'seepast\[cuda12\]'"):
        backends.get("cuda")
    monkeypatch.setattr(backends.importlib.util, "find_spec", lambda name: None)
    backends._fastest.cache_clear()
    assert backends.get("auto") is backends.get("cpu") and not caplog.records
    backends._fastest.cache_clear()


def test_without_the_compiler_the_extra_is_named(monkeypatch) -> None:
    monkeypatch.setattr(nvrtc, "_places", lambda major: [])
    monkeypatch.setattr(nvrtc.ctypes, "CDLL", lambda place: (_ for _ in ()).throw(OSError(place)))
    with pytest.raises(BackendError, match=r"libnvrtc\.so\.13: pip install 'seepast\[cuda13\]'"):
        nvrtc.compiler.__wrapped__(13)
