"""16-bit PNG pictures to and from `nodes.Raster`'s bytes, lossless: grey or RGB, with or without alpha.

Pillow narrows 16-bit RGB to 8 bits without a word, so the few chunks are written and read here (PNG 1.2, RFC 2083).
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOR_TYPES = {1: 0, 2: 4, 3: 2, 4: 6}
"""channels -> PNG's colour type: grey, grey with alpha, RGB, RGB with alpha."""

MAX_NUMBERS = 2**26
"""Most numbers (channels * height * width) that a picture may have: a 4096 x 4096 RGB picture and then some."""


class PngError(ValueError):
    """The bytes are not a PNG that can be read here."""


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def write_png(pixels: np.ndarray) -> bytes:
    """A PNG file.

    Args:
        pixels: (C, H, W) uint16, C from 1 to 4.
    Returns:
        the bytes of a 16-bit PNG without colour space, its rows filtered with "up". Raises PngError.
    """
    channels, height, width = pixels.shape
    if channels not in COLOR_TYPES:
        raise PngError(f"a PNG has 1 to 4 channels, got {channels}")
    if pixels.size > MAX_NUMBERS:
        raise PngError(f"a raster may hold {MAX_NUMBERS} numbers at most, got {pixels.size}")
    rows = np.ascontiguousarray(pixels.transpose(1, 2, 0)).astype(">u2").view(np.uint8).reshape(height, -1)
    up = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))
    filtered = np.concatenate([np.full((height, 1), 2, np.uint8), up], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 16, COLOR_TYPES[channels], 0, 0, 0)
    return SIGNATURE + _chunk(b"IHDR", header) + _chunk(b"IDAT", zlib.compress(filtered.tobytes(), 9)) + _chunk(b"IEND", b"")


def read_png(data: bytes) -> np.ndarray:
    """The pixels of a PNG of 8 or 16 bits, (C, H, W) uint16; 8-bit numbers are widened (times 257).

    Raises PngError for anything else: truncated, interlaced, with a palette, or larger than `MAX_NUMBERS`, which is
    noticed before the pixels are decoded.
    """
    header, packed = _chunks(data)
    width, height, depth, color_type, _, _, interlaced = struct.unpack(">IIBBBBB", header)
    channels = {color: count for count, color in COLOR_TYPES.items()}.get(color_type)
    if channels is None or depth not in (8, 16) or interlaced:
        raise PngError("expected a PNG of 8 or 16 bits without palette or interlacing")
    if not 0 < width * height * channels <= MAX_NUMBERS:
        raise PngError(f"{width} x {height} pixels are not between 1 and {MAX_NUMBERS} numbers")
    step = channels * depth // 8
    size = height * (1 + width * step)
    unpacker = zlib.decompressobj()
    try:
        filtered = unpacker.decompress(packed, size)
    except zlib.error as error:
        raise PngError(f"the PNG is damaged: {error}") from None
    if len(filtered) != size:
        raise PngError("the PNG is truncated")
    rows = _unfiltered(np.frombuffer(filtered, np.uint8).reshape(height, -1), step)
    numbers = rows.view(">u2") if depth == 16 else rows.astype(np.uint16) * 257
    return numbers.reshape(height, width, channels).transpose(2, 0, 1).astype(np.uint16)


def _chunks(data: bytes) -> tuple[bytes, bytes]:
    """The header and all IDAT chunks joined. Checksums are checked."""
    if not data.startswith(SIGNATURE):
        raise PngError("expected PNG data")
    header, packed, position = b"", [], len(SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        name, body = data[position + 4 : position + 8], data[position + 8 : position + 8 + length]
        if data[position + 8 + length : position + 12 + length] != struct.pack(">I", zlib.crc32(name + body)):
            raise PngError("the PNG is truncated or damaged (a checksum is wrong)")
        if name == b"IHDR":
            header = body
        elif name == b"IDAT":
            packed.append(body)
        elif name == b"IEND":
            break
        position += 12 + length
    if len(header) != 13 or not packed:
        raise PngError("the PNG is truncated")
    return header, b"".join(packed)


def _unfiltered(rows: np.ndarray, step: int) -> np.ndarray:
    """Undo each row's filter (RFC 2083, section 6); ``rows`` begin with the filter's number."""
    result = np.zeros((rows.shape[0] + 1, rows.shape[1] - 1), np.uint8)
    for y, row in enumerate(rows, start=1):
        kind, line, above = row[0], row[1:], result[y - 1]
        if kind == 0:
            result[y] = line
        elif kind == 1:
            result[y] = line.reshape(-1, step).cumsum(axis=0, dtype=np.uint8).reshape(-1)
        elif kind == 2:
            result[y] = line + above
        elif kind in (3, 4):
            result[y] = _unfiltered_left(int(kind), line, above, step)
        else:
            raise PngError(f"the PNG is damaged (filter {kind})")
    return np.ascontiguousarray(result[1:])


def _unfiltered_left(kind: int, line: np.ndarray, above: np.ndarray, step: int) -> np.ndarray:
    """The filters "average" (3) and "Paeth" (4), whose every byte waits for the one to its left."""
    out = [0] * step + [0] * len(line)
    up = [0] * step + above.tolist()
    for x, byte in enumerate(line.tolist(), start=step):
        a, b, c = out[x - step], up[x], up[x - step]
        if kind == 3:
            guess = (a + b) // 2
        else:
            near = a + b - c
            guess = min((abs(near - a), 0, a), (abs(near - b), 1, b), (abs(near - c), 2, c))[2]
        out[x] = (byte + guess) & 255
    return np.array(out[step:], np.uint8)
