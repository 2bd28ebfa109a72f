"""NVIDIA's run-time compiler, from C to the PTX that a driver takes. JAX's CUDA packages bring it along."""

from __future__ import annotations

import ctypes
import ctypes.util
import functools
import hashlib
import importlib.util
import os
import pathlib
import warnings

import jax


class CompileError(RuntimeError):
    """NVRTC does not take a program; the text is its log."""


@functools.cache
def library() -> ctypes.CDLL | None:
    """NVRTC, or None where there is none."""
    for path in (*_packaged(), ctypes.util.find_library("nvrtc"), "libnvrtc.so.13", "libnvrtc.so.12", "libnvrtc.so"):
        if path:
            try:
                return ctypes.CDLL(str(path))
            except OSError:
                pass
    return None


def _packaged():
    """Where pip puts it: nvidia/cu13/lib, nvidia/cuda_nvrtc/lib."""
    spec = importlib.util.find_spec("nvidia")
    for folder in spec.submodule_search_locations or () if spec else ():
        yield from sorted(pathlib.Path(folder).glob("*/lib/libnvrtc.so.*"), reverse=True)


@functools.lru_cache(maxsize=64)
def ptx(text: str, capability: str) -> str:
    """The PTX of a program for a GPU of this compute capability ("9.0"); JAX's persistent cache keeps it too.

    Raises:
      CompileError: there is no NVRTC, or it refuses the program.
    """
    folder = jax.config.jax_compilation_cache_dir
    if not folder or "://" in folder:
        return compiled(text, capability)
    key = hashlib.sha256(f"{version()} {capability} {text}".encode()).hexdigest()
    path = pathlib.Path(folder) / f"rbd_jax-{key}.ptx"
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        code = compiled(text, capability)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = path.with_suffix(f".{os.getpid()}")
        aside.write_text(code, encoding="utf-8")
        aside.replace(path)
    except OSError as reason:  # a cache that cannot be written is none
        warnings.warn(f"{path} was not written: {reason}", stacklevel=2)
    return code


@functools.cache
def version() -> tuple[int, int]:
    """NVRTC's version, (0, 0) where there is none."""
    nvrtc, numbers = library(), (ctypes.c_int(), ctypes.c_int())
    if nvrtc is not None:
        _check(nvrtc, nvrtc.nvrtcVersion(*map(ctypes.byref, numbers)))
    return tuple(n.value for n in numbers)


def compiled(text: str, capability: str) -> str:
    """As ``ptx``, compiled now."""
    nvrtc = library()
    if nvrtc is None:
        raise CompileError("NVRTC was not found")
    options = [f"--gpu-architecture=compute_{capability.replace('.', '')}", "--std=c++17"]
    program = ctypes.c_void_p()
    _check(nvrtc, nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"worlds.cu", 0, None, None))
    try:
        given = (ctypes.c_char_p * len(options))(*(o.encode() for o in options))
        if nvrtc.nvrtcCompileProgram(program, len(options), given):
            raise CompileError(_text(nvrtc, program, "ProgramLog"))
        return _text(nvrtc, program, "PTX")
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _text(nvrtc, program, what: str) -> str:
    size = ctypes.c_size_t()
    _check(nvrtc, getattr(nvrtc, f"nvrtcGet{what}Size")(program, ctypes.byref(size)))
    buffer = ctypes.create_string_buffer(size.value)
    _check(nvrtc, getattr(nvrtc, f"nvrtcGet{what}")(program, buffer))
    return buffer.value.decode()


def _check(nvrtc, code: int) -> None:
    if code:
        nvrtc.nvrtcGetErrorString.restype = ctypes.c_char_p
        raise CompileError(nvrtc.nvrtcGetErrorString(code).decode())
