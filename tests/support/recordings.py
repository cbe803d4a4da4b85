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


def write_cine(path, frames, bits=16, *, first_image=-5, version=1, annotation=b"", top_down=False, **setup):
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
    version : {0, 1}
        0 stores the offsets of images in 32 bits, 1 in 64 bits.
    annotation : bytes
        Text before each image.
    top_down : bool
        Whether unpacked rows are stored from the top, which a negative ``biHeight`` says.
    **setup
        ``RealBPP``, ``CFA`` of the SETUP structure; ``Compression`` of the file's header.
    """
    frames = np.asarray(frames)
    count, rows, columns = frames.shape
    packed = {10: PACKED_10, 12: PACKED_12}.get(bits, 0)
    compression = setup.pop("Compression", 0)
    setup_at, blocks_at = 44 + 40, 44 + 40 + SETUP_BYTES
    blocks = _tagged_blocks(count)
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
            "<cih><fileInfo><date>2026/1/1</date></fileInfo><deviceInfo><deviceName>FASTCAM</deviceName></deviceInfo>"
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
    struct.pack_into("<I", setup, 768, 1000)  # images a second
    struct.pack_into("<I", setup, 800, 700)  # version of the software
    struct.pack_into("<I", setup, 808, fields.get("CFA", 0))
    struct.pack_into("<I", setup, 896, fields["RealBPP"])
    return bytes(setup)


def _tagged_blocks(count):
    """Return the blocks of times and exposures of each image."""
    times = struct.pack(f"<{count}Q", *(number << 20 for number in range(count)))
    exposures = struct.pack(f"<{count}I", *(1 << 10,) * count)
    blocks = struct.pack("<IHH", 8 + len(times), 1002, 1) + times
    return blocks + struct.pack("<IHH", 8 + len(exposures), 1003, 0) + exposures


def _mraw_pixels(frame, bits):
    if bits == 12:
        return pack_12(frame)
    return np.asarray(frame, {8: np.uint8, 16: np.dtype("<u2")}[bits]).tobytes()
