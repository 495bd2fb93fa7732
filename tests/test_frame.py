"""The layout of XLA's frames that machine code reads, against the header of the JAX that is installed."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path

import jax

from switchfit.engine.native import program

HEADER = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text()

WORDS = {"size_t": ctypes.c_size_t, "int64_t": ctypes.c_int64, "int32_t": ctypes.c_int32, "int": ctypes.c_int}


def structure(name: str) -> type[ctypes.Structure]:
    """A struct of the header as ctypes has it: pointers, integers, enumerations, and structs in it."""
    body = re.search(rf"struct XLA_FFI_{name} \{{(.*?)\n\}}[^;]*;", HEADER, re.S)
    assert body is not None, f"the header has no struct {name}"
    code = re.sub(r"//[^\n]*|/\*.*?\*/", "", body[1], flags=re.S)
    fields = []
    for declaration in filter(None, (part.strip() for part in code.split(";"))):
        kind, field = declaration.rsplit(maxsplit=1)
        fields.append((field, kind_of(kind.removeprefix("struct ").removeprefix("const "))))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def kind_of(kind: str):
    if kind.endswith("*"):
        return ctypes.c_void_p
    if kind in WORDS:
        return WORDS[kind]
    if re.search(rf"struct {kind} \{{", HEADER):
        return structure(kind.removeprefix("XLA_FFI_"))
    if re.search(rf"typedef uint32_t {kind};", HEADER):
        return ctypes.c_uint32
    assert re.search(rf"\}} {kind};", HEADER), f"the header has no {kind}"
    return ctypes.c_int  # an enumeration


def test_what_is_read_stands_where_the_header_says():
    call, buffer = structure("CallFrame"), structure("Buffer")
    assert call.extension_start.offset == program.EXTENSION
    assert call.args.offset + structure("Args").args.offset == program.ARGUMENTS
    assert call.rets.offset + structure("Rets").rets.offset == program.RESULTS
    assert (buffer.data.offset, buffer.dims.offset) == (program.DATA, program.DIMENSIONS)
    assert structure("Extension_Base").type.offset == 8
    assert structure("Metadata_Extension").metadata.offset == 24
    metadata, version = structure("Metadata"), structure("Api_Version")
    assert metadata.api_version.offset + version.major_version.offset == 24
    assert metadata.api_version.offset + version.minor_version.offset == 28
    assert metadata.traits.offset == 32


def test_the_version_of_the_interface_is_one_that_xla_takes():
    major, minor = (int(re.search(rf"#define XLA_FFI_API_{name} (\d+)", HEADER)[1]) for name in ("MAJOR", "MINOR"))
    assert major == program.MAJOR
    assert minor >= program.MINOR
