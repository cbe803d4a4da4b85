"""Mutations of TOML files: keys removed, values replaced by extremes and odd text, tables nested, lists lengthened."""

import re

from hypothesis import strategies as st

NUMBERS = (
    "0", "-0.0", "-1", "1", "2", "3.5", "1e308", "-1e308", "1.7976931348623157e308", "1e-308", "5e-324", "1e30",
    "-1e30", "1e-30", "1e15", "1e9", "1e-9", "1e6", "1e-6", "1000000", "1000000000", "9223372036854775807",
    "9223372036854775808", "-9223372036854775809", "1" * 400, "7" * 4301, "-" + "3" * 9000, "0x" + "f" * 5000,
    "1." + "0" * 5000, "nan", "-nan", "inf", "-inf", "1e99999", "0.1", "1e3", "1e-3", "1e4", "1e5", "360", "1e2",
)  # fmt: skip
"""Numbers at and beyond every bound."""

TEXTS = (
    '""', '"\\u0000"', '"a\\u0000b"', '"\\u001b[31mred\\u001b[0m"', '"\\r\\nlfpiv: done"', '"\\u202egpj.exe"',
    '"\\uFFFF"', '"/dev/zero"', '"/dev/stdin"', '"."', '".."', '"../../../../etc/passwd"', '"/"', '"~"', '"a/../b.tif"',
    f'"{"x" * 256}"', f'"{"x" * 255}.tif"', f'"{"é" * 200}.tif"', f'"{"d/" * 2500}x.tif"', f'"{"y" * 100_000}"',
    '"{pair:1000000000d}"', '"{pair:010000000d}.tif"', '"{pair!r:>99999999}"', '"{camera.__class__}"',
    '"{camera.__class__.__mro__}{pair}{frame}"', '"{pair[0]}"', '"{0}"', '"{}"', '"{pair:{frame}}"', '"{pair"', '"}"',
    '"{{pair}}"', '"{camera}/{pair:04d}{frame}.tif"', '"{camera!s}{pair}{frame}"', '"{camera:>99999999}{pair}{frame}"',
    '"{frame:99999999}"', '"{pair:,}"', '"{pair:x}{frame}{camera}"', '"{instant}"', '"{image}"', '"{plane:9999999d}"',
    '"white/left.tif#0"', '"white/left.tif#99999999999999999999"', '"x.h5#a[1]"', '"auto"', '"none"', '"left"',
    "'C:\\temp\\x.tif'", '"""a\nb"""', '"\U0001f4a9.tif"',
)  # fmt: skip
"""Text that is no name, leaves its folder, or asks a format for a gigabyte."""

OTHERS = (
    "true", "false", "[]", "[[]]", "{}", "[1, 2]", "[1e308, 1e308, 1e308]", "[0, 0, 0]", "[1e-308, 0, 0]", "[0.1]",
    "2026-11-22", "2026-11-22T10:00:00Z", "07:32:00", "{kind = 'box'}", "[{}]", "[true, 'a', 1.0]", "null", "=", "",
    "[" * 20 + "]" * 20, "[" * 2000 + "]" * 2000, "{a=" * 300 + "1" + "}" * 300, "[" * 100_000,
    f"[{', '.join(['0.5'] * 20_000)}]", f"[{', '.join(map(str, range(3000)))}]",
    "[1000000, 1000000]", "[999, 999]", "[1e6, 1e6, 1e6]", "[1e-6, 1e-6, 1e-6]", "[1e5, 1e5, 1e5]", "[64, 64, 64]",
    "[[4, 4, 4], 4]", "[-1e6, 1e6]", "[[1e6, 1e6, 1e6], [0, 0, 0]]",
)  # fmt: skip
"""Values of other types and shapes."""

LINES = (
    "[volume]", "[smart]\niterations = 1000000", "[network]\nhidden = [1000, 1000]", "[network]\nhidden = [1000]",
    "[correlation]\nwindows = [4096]", "[correlation]\nmax_displacement_voxel = 1e6", "[compute]\nthreads = 1024",
    "[compute]\nmemory_gib = 1e-300", "[self_calibration]\npairs = 1000000000", ".".join("a" * 5000) + " = 1",
    "[" + ".".join("b" * 3000) + "]", ".".join(["'q'"] * 4000) + " = 1", "k" * 100_000 + " = 1", "\x00", "\x1b[2J", "=",
    "[[camera]]\nname = 'third'", "[[camera]]\n" * 3000, "#" + "c" * 200_000, "[[volume.solid]]\nkind = 'half_space'\n"
    "point_mm = [0, 0, 0]\nnormal = [1e-300, 0, 0]", "[[volume.solid]]\nkind = 'box'\ncentre_mm = [0, 0, 0]\n"
    "size_mm = [0.1, 0.1, 0.1]", "\n".join(f"unknown_{number} = {number}" for number in range(5000)),
    "[particles.deeper]\nx = 1", "guard_mm = 1e6", "guard_mm = [0, 0, 1e300]", "pairs = 100000000",
    "instants = 2000000", "first = 999999999", "seed = 170141183460469231731687303715884105727",
    "frames = ['\\u0000', 'b']", "\ufeff",
)  # fmt: skip
"""Lines that a file may gain."""

values = st.one_of(
    st.sampled_from(NUMBERS),
    st.sampled_from(TEXTS),
    st.sampled_from(OTHERS),
    st.floats().map(repr),
    st.integers(-(10**25), 10**25).map(str),
    st.builds(lambda sign, digit, power: f"{sign}{digit}e{power}", st.sampled_from(("", "-")), st.integers(1, 9),
              st.integers(-330, 330)),
    st.text(max_size=40).map(lambda text: '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'),
)  # fmt: skip


@st.composite
def mutated(draw, text):
    """Return a TOML text with one to three mutations of its lines, as bytes."""
    lines = text.splitlines()
    for _ in range(draw(st.integers(1, 3))):
        keys = [number for number, line in enumerate(lines) if re.match(r"[\w.]+ *=", line)]
        how = draw(st.sampled_from(("value", "value", "value", "item", "remove", "gain", "rename", "nest", "repeat")))
        at = draw(st.sampled_from(keys)) if keys else 0
        name, _, value = lines[at].partition("=")
        if how == "value":
            lines[at] = f"{name}= {draw(values)}"
        elif how == "item" and (items := re.findall(r"[^\s,\[\]]+", value)):
            one = draw(st.sampled_from(items))
            lines[at] = f"{name}={value.replace(one, draw(values), draw(st.sampled_from((1, -1))))}"
        elif how == "remove":
            del lines[at]
        elif how == "gain":
            lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(LINES)))
        elif how == "rename":
            lines[at] = (
                f"{draw(st.sampled_from((name.strip() + 'x', 'kind', 'name', '__class__', 'f_number')))} ={value}"
            )
        elif how == "nest":
            depth = draw(st.sampled_from((1, 2, 5, 17, 100, 400, 5000)))
            lines[at] = f"{name}= {'[' * depth}{value}{']' * depth}"
        elif how == "repeat":
            times = draw(st.sampled_from((1, 2, 50, 5000)))
            lines[at] = f"{name}= [{', '.join([value.strip()] * times)}]"
        if not lines:
            lines = [""]
    content = "\n".join(lines).encode(errors="surrogatepass")
    if draw(st.integers(0, 19)) == 0:  # bytes that are no text
        place = draw(st.integers(0, len(content)))
        content = content[:place] + draw(st.binary(min_size=1, max_size=20)) + content[place:]
    return content
