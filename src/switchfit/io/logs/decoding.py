"""The text of a file: its encoding is found out, and gzip is decompressed."""

from __future__ import annotations

import codecs
import gzip
import re
from pathlib import Path

from switchfit.io.logs.refusals import explain_damage
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors

GZIP = b"\x1f\x8b"


def decode(path: Path) -> str:
    """Return the text of a file: UTF-8 or UTF-16 by its byte order mark, UTF-8, or else Latin-1.

    Raises
    ------
    InputError
        If the file cannot be read or is no text.
    """
    with explain_read_errors(path):
        data = path.read_bytes()
    # By the first bytes, not by the name: loggers compress without saying so.
    if data.startswith(GZIP):
        with explain_damage(path, "a file that is compressed by gzip"):
            data = gzip.decompress(data)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        with explain_damage(path, "text in UTF-16"):
            return data.decode("utf-16")
    # Control characters other than tab and the ends of lines occur in no encoding of text that is read here. A bag or a
    # spreadsheet with the wrong ending is refused with its first such byte, instead of with a strange cell.
    binary = re.search(rb"[\x00-\x08\x0e-\x1a]", data)
    if binary:
        raise InputError(
            f"{path} is not a text file (byte {binary.start()} is {data[binary.start()]}); export it as CSV."
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Every byte is a character of Latin-1, so this cannot fail: what is wrong then are letters such as a degree
        # sign, never numbers.
        return data.decode("latin-1")
