"""Write recordings in the cameras' own formats, from their published layouts.

The layouts are those of Vision Research ("Cine File Format"), Photron (the text header of ``.cih``, the XML header of
``.cihx``) and PCO (appendix "Image file formats" of the cameras' manuals). No reader of the package is used here.
"""

import struct

import numpy as np

PACKED_10, PACKED_12 = 256, 1024
"""``biCompression`` of packed pixels."""
SETUP_BYTES = 10392
"""Length of the SETUP structure up to ``WBType``."""


def write_cine(path, frames, bits=16, *, interval_s=None, exposure_s=None, first_image=-5, blocks=True, **setup):
    """Write a Phantom ``.cine`` of monochrome images.

    Parameters
    ----------
    path : Path
    frames : array_like, shape (n, rows, columns)
        Grey values, first row on top. With `bits` 10 the codes of the packed form, which a table turns into counts.
    bits : {8, 16, 10, 12}
        Bits of a stored pixel; 10 and 12 are the packed forms.
    first_image : int
        ``FirstImageNo``, the number of the first image relative to the trigger.
    interval_s, exposure_s : float, optional
        Time between images and their exposure, in the blocks of times.
    blocks : bool
        Whether there are blocks of times and exposures.
    **setup
        ``RealBPP``, ``CFA``, ``bFlipH``, ``bFlipV``, ``Rotate``, ``TrigFrame``, ``WhiteLevel``, ``rate`` of SETUP;
        ``Compression`` of the file's header; ``version`` 0 for offsets in 32 bits; ``annotation``, a text before each
        image; ``top_down`` where unpacked rows are stored from the top, which a negative ``biHeight`` says.
    """
    frames = np.asarray(frames)
    count, rows, columns = frames.shape
    packed = {10: PACKED_10, 12: PACKED_12}.get(bits, 0)
    compression, version = setup.pop("Compression", 0), setup.pop("version", 1)
    annotation, top_down = setup.pop("annotation", b""), setup.pop("top_down", False)
    setup_at, blocks_at = 44 + 40, 44 + 40 + SETUP_BYTES
    blocks = _tagged_blocks(count, interval_s or 2**-12, exposure_s or 2**-22) if blocks else b""
    offsets_at = blocks_at + len(blocks)
    images_at = offsets_at + count * (8 if version else 4)
    images = [_cine_pixels(frame, bits, top_down) for frame in frames]
    size = 8 + len(annotation) + (len(images[0]) if images else 0)
    offsets = [images_at + number * size for number in range(count)]
    head = struct.pack("<2sHHHiIiI", b"CI", 44, compression, version, first_image, count, first_image, count)
    head += struct.pack("<IIIQ", 44, setup_at, offsets_at, 1_700_000_000 << 32)
    stored_bits = 16 if packed else bits
    signed_rows = -rows if top_down else rows
    bitmap = struct.pack("<IiiHHIIiiII", 40, columns, signed_rows, 1, stored_bits, packed, size, 0, 0, 0, 0)
    with path.open("wb") as file:
        file.write(head + bitmap + _cine_setup(columns, rows, {"RealBPP": bits, **setup}) + blocks)
        file.write(struct.pack(f"<{count}{'q' if version else 'I'}", *offsets))
        for image in images:
            file.write(struct.pack("<I", 8 + len(annotation)) + annotation + struct.pack("<I", len(image)) + image)


def write_mraw(path, frames, bits=16, *, header="cih", **entries):
    """Write a Photron ``.mraw`` and the text or XML header beside it.

    Parameters
    ----------
    path : Path
    frames : array_like, shape (n, rows, columns)
    bits : {8, 12, 16}
        Bits of a stored pixel; 12 is packed.
    header : {"cih", "cihx"}
    **entries
        Entries of a ``.cih`` that replace the usual ones, with ``_`` for a space.
    """
    frames = np.asarray(frames)
    count, rows, columns = frames.shape
    path.write_bytes(b"".join(_mraw_pixels(frame, bits) for frame in frames))
    if header == "cihx":
        text = (
            "<cih><fileInfo><date>2026/1/1</date></fileInfo><deviceInfo><deviceName>FASTCAM</deviceName><sensor><width>4"
            "</width><height>4</height></sensor></deviceInfo><displayInfo><type>LUT</type><bit>8</bit></displayInfo>"
            f"<frameInfo><totalFrame>{count}</totalFrame></frameInfo><imageDataInfo><resolution><width>{columns}</width>"
            f"<height>{rows}</height></resolution><colorInfo><type>Mono</type><bit>{bits}</bit></colorInfo>"
            "<effectiveBit><depth>12</depth><side>Lower</side></effectiveBit></imageDataInfo>"
            "<imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo></cih>"
        )
        path.with_suffix(".cihx").write_bytes(b"\x00\x01binary" + text.encode() + b"\x00\x02")
        return
    lines = {
        "Date": "2026/1/1",
        "Camera Type": "FASTCAM SA-Z",
        "Record Rate(fps)": 20000,
        "Total Frame": count,
        "Original Total Frame": count,
        "Start Frame": 0,
        "Image Width": columns,
        "Image Height": rows,
        "Color Type": "Mono",
        "Color Bit": bits,
        "File Format": "MRaw",
        "EffectiveBit Depth": min(bits, 12),
        "EffectiveBit Side": "Lower",
    } | {key.replace("_", " "): value for key, value in entries.items()}
    text = "#Camera Information Header\n" + "".join(f"{key} : {value}\n" for key, value in lines.items()) + "END\n"
    path.with_suffix(".cih").write_text(text, "utf-8")


def write_seq(path, frames, *, version=5, bits=None, interval_s=0.01, filling=40, **fields):
    """Write a StreamPix ``.seq`` of grey images.

    Parameters
    ----------
    path : Path
    frames : array_like, shape (n, rows, columns)
        Grey values of 8 or 16 bits.
    version : int
        From 5 on images begin at byte 8192 and times have microseconds.
    bits : int, optional
        Bits that are used, of those that are stored.
    interval_s : float
        Time between images.
    filling : int
        Bytes behind the time of each image.
    **fields
        ``count``, ``origin``, ``form`` and ``compression`` of the header.
    """
    frames = np.asarray(frames)
    count, rows, columns = frames.shape
    stored, length = 8 * frames.itemsize, rows * columns * frames.itemsize
    times = struct.Struct("<IHH" if version >= 5 else "<IH")
    head = struct.pack("<I24sii512x", 0xFEED, "Norpix seq\n".encode("utf-16-le"), version, 1024)
    sizes = (columns, rows, stored, bits or stored, length, fields.get("form", 100), fields.get("count", count))
    head += struct.pack("<9Id", *sizes, fields.get("origin", 0), length + times.size + filling, 30.0)
    head = head.ljust(620, b"\0") + struct.pack("<I", fields.get("compression", 0))
    with path.open("wb") as file:
        file.write(head.ljust(8192 if version >= 5 else 1024, b"\0"))
        for number, frame in enumerate(frames):
            micro = round(number * interval_s * 1e6) + 999_500
            parts = (1_700_000_000 + micro // 10**6, micro // 1000 % 1000, micro % 1000)
            file.write(frame.astype(frame.dtype.newbyteorder("<")).tobytes())
            file.write(times.pack(*parts[: 3 if version >= 5 else 2]) + b"\xff" * filling)


def write_avi(path, frames, *, code=bytes(4), bits=8, palette=True, top_down=False, parts=1, dropped=()):
    """Write an uncompressed ``.avi`` of bitmaps, or of a grey code whose rows are stored from the top.

    Parameters
    ----------
    path : Path
    frames : array_like, shape (n, rows, columns)
    code : bytes
        Four letters of the format; zeros for a bitmap.
    bits : int
        Bits that the bitmap states.
    palette : bool or bytes
        Whether there is a palette of grey values; or another one.
    top_down : bool
        Whether rows are stored from the top.
    parts : int
        Number of RIFF parts over which images are spread.
    dropped : collection of int
        Images whose chunks are empty.
    """
    frames = np.asarray(frames)
    count, rows, columns = frames.shape
    greys = bytes(value for level in range(256) for value in (level, level, level, 0))
    colours = greys if palette is True else palette or b""
    form = (
        struct.pack("<IiiHH4sIiiII", 40, columns, -rows if top_down else rows, 1, bits, code, 0, 0, 0, 0, 0) + colours
    )
    stream = _chunk(b"strh", b"vids" + code + bytes(48)) + _chunk(b"strf", form)
    sound = _chunk(b"strh", b"auds" + bytes(52)) + _chunk(b"strf", bytes(18))
    head = _chunk(b"avih", bytes(56)) + _list(b"strl", sound) + _list(b"strl", stream)
    from_top = top_down or code.strip(b"\0") not in (b"", b"DIB ")
    images = []
    for number, frame in enumerate(frames):
        stored = np.ascontiguousarray(frame if from_top else frame[::-1]).view(np.uint8).reshape(rows, -1)
        filled = np.pad(stored, ((0, 0), (0, -stored.shape[1] % 4))).tobytes()
        images.append(_chunk(b"00db", b"" if number in dropped else filled))
    share = -(-count // parts)
    split = [b"".join(images[at : at + share]) for at in range(0, count, share)]
    first = _list(b"hdrl", head) + _chunk(b"JUNK", bytes(11)) + _list(b"movi", split[0]) + _chunk(b"idx1", bytes(16))
    rest = (_list(b"AVIX", _list(b"movi", part), b"RIFF") for part in split[1:])
    path.write_bytes(b"".join([_list(b"AVI ", first, b"RIFF"), *rest]))


def write_b16(path, image, *, comment=b"", extended=True):
    """Write a PCO ``.b16`` image, with the extended header and a comment or with the six basic numbers only.

    Parameters
    ----------
    path : Path
    image : array_like, shape (rows, columns)
        Counts of 16 bits.
    comment : bytes
    extended : bool
    """
    pixels = np.asarray(image, "<u2")
    rows, columns = pixels.shape
    head_bytes = (128 if extended else 24) + len(comment)
    head = struct.pack("<4siiiii", b"PCO-", head_bytes + pixels.nbytes, head_bytes, columns, rows, -extended)
    if extended:
        head += struct.pack("<26i", 0, 0, 4095, *(0,) * 23)
    path.write_bytes(head + comment + pixels.tobytes())


def pack_10(codes):
    """Pack codes of 10 bits, four in five bytes, the highest bits first."""
    a, b, c, d = (np.asarray(codes, np.uint16).ravel()[at::4] for at in range(4))
    rows = [a >> 2, (a & 3) << 6 | b >> 4, (b & 15) << 4 | c >> 6, (c & 63) << 2 | d >> 8, d & 255]
    return np.stack(rows, axis=1).astype(np.uint8).tobytes()


def pack_12(counts):
    """Pack counts of 12 bits, two in three bytes, the highest bits first."""
    a, b = (np.asarray(counts, np.uint16).ravel()[at::2] for at in range(2))
    return np.stack([a >> 4, (a & 15) << 4 | b >> 8, b & 255], axis=1).astype(np.uint8).tobytes()


def _cine_pixels(frame, bits, top_down):
    """Return the stored pixels of an image: packed ones from the top, others from the bottom."""
    if bits == 10:
        return pack_10(frame)
    if bits == 12:
        return pack_12(frame)
    rows = np.asarray(frame, {8: np.uint8, 16: np.dtype("<u2")}[bits])[:: 1 if top_down else -1]
    missing = -rows.shape[1] * rows.itemsize % 4  # rows begin at multiples of four bytes
    return np.pad(rows.view(np.uint8), ((0, 0), (0, missing))).tobytes()


def _cine_setup(columns, rows, fields):
    """Return the SETUP structure with the fields that describe pixels."""
    setup = bytearray(SETUP_BYTES)
    struct.pack_into("<2sH", setup, 140, b"ST", SETUP_BYTES)
    struct.pack_into("<HH", setup, 737, columns, rows)
    setup[17] = fields.get("TrigFrame", 0)
    struct.pack_into("<ii", setup, 756, fields.get("bFlipH", 0), fields.get("bFlipV", 0))
    struct.pack_into("<I", setup, 768, fields.get("rate", 1000))  # images a second
    struct.pack_into("<i", setup, 884, fields.get("Rotate", 0))
    struct.pack_into("<I", setup, 800, 700)  # version of the software
    struct.pack_into("<I", setup, 808, fields.get("CFA", 0))
    struct.pack_into("<I", setup, 896, fields["RealBPP"])
    struct.pack_into("<i", setup, 5736, fields.get("WhiteLevel", 0))
    return bytes(setup)


def _tagged_blocks(count, interval_s, exposure_s):
    """Return the blocks of times and exposures of each image, in 2^-32 seconds."""
    start = 1_700_000_000 << 32
    times = struct.pack(f"<{count}Q", *(start + round(number * interval_s * 2**32) for number in range(count)))
    exposures = struct.pack(f"<{count}I", *(round(exposure_s * 2**32),) * count)
    blocks = struct.pack("<IHH", 8 + len(times), 1002, 1) + times
    return blocks + struct.pack("<IHH", 8 + len(exposures), 1003, 0) + exposures


def _chunk(name, content):
    return name + struct.pack("<I", len(content)) + content + bytes(len(content) % 2)


def _list(kind, content, name=b"LIST"):
    return _chunk(name, kind + content)


def _mraw_pixels(frame, bits):
    if bits == 12:
        return pack_12(frame)
    return np.asarray(frame, {8: np.uint8, 16: np.dtype("<u2")}[bits]).tobytes()
