"""C++ of the area-integrated weights: how much room a voxel's blocks need, and the blocks; see ``footprint``."""

from lfpiv_kernels.weights.ray_model import LANES, LEVELS, RAYS, SMEARS, VECTORS

SIDE_LAYERS = 1
"""Versions of a microimage to either side of the plain one, for weights that fall or rise outwards at its edge."""
LAYERS = 2 * SIDE_LAYERS + 1
LAYER_FALL = 0.6
"""Relative fall of the weight per pixel, outwards at the pupil's edge, between one version and the next."""
HEADROOM = 1.04
"""Largest value that a profile or weight can take, over that at the pupil's centre."""
TALLEST = 64
"""Rows of a block at most."""
RIM = 0.05
"""Width around the pupil within which a pixel still counts as touching it [pixel]: more than its share's rounding."""
MOST_PARTS = 64
"""Parts of a voxel at most."""
MOST_STEPS = 8
"""Steps of a cell's outline at most."""


def _source(text: str) -> str:
    """Complete a function's text: vectors and the ray model before it, values for `@NAME` in it."""
    for name, value in (
        ("TALLEST", TALLEST),
        ("LANES", LANES),
        ("SIDE_LAYERS", SIDE_LAYERS),
        ("LAYERS", LAYERS),
        ("LAYER_FALL", f"{LAYER_FALL}f"),
        ("LEVELS", f"{LEVELS}f"),
        ("HEADROOM", f"{HEADROOM}f"),
        ("RIM", f"{RIM}f"),
        ("MOST_PARTS", MOST_PARTS),
        ("MOST_STEPS", MOST_STEPS),
    ):
        text = text.replace(f"@{name}", str(value))
    return VECTORS + RAYS + SMEARS + text


MEASURE = _source("""
    int blocks = 0, bytes = 0;
    for (int n = 0; n < reached; n += W) {
        int lens[2 * W], corner[2 * W];
        V centre_s, centre_t, first_column, first_row, box[4], middle[2];
        take_lenses(lens, corner, centre_s, centre_t, first_column, first_row);
        const M lit = pixel_box(reached - n, centre_s, centre_t, first_column, first_row, box, middle);
        if (!any(lit)) continue;
        const V tiles = down((box[1] - box[0] + (float)@LANES) / (float)@LANES), rows = box[3] - box[2] + 1.0f;
        const V parts = down((rows + (float)(@TALLEST - 1)) / (float)@TALLEST), none = V{};
        const V values = profiles ? tiles * (rows + parts * (float)@LANES) : tiles * rows * (float)@LANES;
        const V lit_blocks = lit ? tiles * parts : none, lit_values = lit ? values : none;
        for (int k = 0; k < W; ++k) {
            blocks += (int)at(lit_blocks, k);
            bytes += (int)at(lit_values, k);
        }
    }
    blocks_out.data[voxel] = blocks;
    bytes_out.data[voxel] = bytes + 2 * @LANES;  // a vector may be stored past the last value
""")
"""Counts the blocks and bytes of values that voxel `voxel` needs at most."""

FILL = _source("""
#if defined(__CUDA_ARCH__)
    auto word = [](const unsigned char* p) {
        uint64_t w = 0;
        for (int k = 0; k < 8; ++k) w |= (uint64_t)p[k] << (8 * k);
        return w;
    };
    auto put_word = [](unsigned char* p, uint64_t w) {
        for (int k = 0; k < 8; ++k) p[k] = (unsigned char)(w >> (8 * k));
    };
    auto first_of = [](uint64_t w) { return __ffsll(w) - 1; };
    auto last_of = [](uint64_t w) { return 63 - __clzll(w); };
    auto store = [](unsigned char* p, V v) { *p = (unsigned char)v; };
#else
    typedef unsigned char bytes __attribute__((vector_size(W), aligned(1)));
    auto word = [](const unsigned char* p) { uint64_t w; __builtin_memcpy(&w, p, 8); return w; };
    auto put_word = [](unsigned char* p, uint64_t w) { __builtin_memcpy(p, &w, 8); };
    auto first_of = [](uint64_t w) { return __builtin_ctzll(w); };
    auto last_of = [](uint64_t w) { return 63 - __builtin_clzll(w); };
    auto store = [](unsigned char* p, V v) {
        *(bytes*)p = __builtin_convertvector(__builtin_convertvector(v, M), bytes);
    };
#endif
    auto bytes_below = [](int n) { return n >= 8 ? ~(uint64_t)0 : ((uint64_t)1 << (8 * n)) - 1; };
    enum { ACROSS = W < 8 ? W : 8, DOWN = W < 8 ? 1 : W / 8 };  // a vector's columns and rows of pixels
    V lane, lane_column, lane_row;
    for (int k = 0; k < W; ++k) {
        put(lane, k, (float)k);
        put(lane_column, k, (float)(k % 8));
        put(lane_row, k, (float)(k / 8));
    }

    // about a pupil point, in the lens's frame (a, b) [pitch]: the turn of offsets from the lens, the change from pixel
    // to pixel, the voxel's edges along a, then b, the smears' widths, the pixel's area on the pupil
    auto local_frame = [&](auto u, auto v, const auto* k, auto* turn, auto* step, auto* edge, auto* smears) {
        auto s = u, t = v;
        decltype(s) less[4] = {1.0f - k[0], -k[1], -k[2], 1.0f - k[3]}, jacobian[4];
        const auto area = size(invert(less, jacobian));
        for (int n = 0; n < 2; ++n) for (int c = 0; c < 2; ++c)
            turn[2 * n + c] = frame[2 * n] * jacobian[c] + frame[2 * n + 1] * jacobian[2 + c];
        for (int n = 0; n < 2; ++n) for (int c = 0; c < 2; ++c)
            step[2 * n + c] = (turn[2 * n] * k[c] + turn[2 * n + 1] * k[2 + c]) * pupil_pixel;
        for (int axis = 0; axis < 3; ++axis) {
            voxel_edge(axis, u, v, s, t);
            for (int n = 0; n < 2; ++n) edge[3 * n + axis] = turn[2 * n] * s + turn[2 * n + 1] * t;
        }
        smear_widths(edge, step, smears);
        return area;
    };

    // what one level stands for: the largest value, from the smears and the area at the pupil's centre
    float top_turn[4], top_step[4], top_edge[6], top[4];
    const float top_area = @HEADROOM * local_frame(0.0f, 0.0f, centre_slope, top_turn, top_step, top_edge, top);
    float top_a = @HEADROOM * trapezium(0.0f, top[0], top[2]) / top[0];
    float top_b = @HEADROOM * trapezium(0.0f, top[1], top[3]) / top[1];
    if (parts > 1) {
        const float* e = top_edge;
        float sum = 0.0f, of_part[6];
        for (int n = 0; n < 6; ++n) of_part[n] = e[n];
        cut_edges(of_part);
        smear_widths(of_part, top_step, top);
        for (int part = 0; part < parts; ++part)
            sum += trapezium(middle_of_part(part, e[0], e[1], e[2]), top[0], top[2])
                * trapezium(middle_of_part(part, e[3], e[4], e[5]), top[1], top[3]);
        top_a = @HEADROOM * @HEADROOM * sum / (parts * top[0] * top[1]), top_b = 1.0f;
    }
    const float amplitude = pupil_pixel * pupil_pixel / (3.14159265f * radius * radius);
    const float top_level = profiles ? @LEVELS * @LEVELS : @LEVELS;
    scale_out.data[voxel] = reached > 0 ? amplitude * top_area * top_a * top_b / top_level : 0.0f;

    // the matrix N = (I - K) F^-1 turns offsets in the lens's frame F into (s, t); its change from column to column and
    // from row to row, and the second order of the offset
    float unframe[4];
    const float frame_area = size(1.0f / invert(frame, unframe));
    const float pupil_2 = pupil_pixel * pupil_pixel;
    float along_column[4], along_row[4];
    for (int n = 0; n < 2; ++n) for (int c = 0; c < 2; ++c) {
        const float* q = m + 3 + 6 * n;
        along_column[2 * n + c] = pupil_pixel * (2.0f * q[0] * unframe[c] + q[1] * unframe[2 + c]);
        along_row[2 * n + c] = pupil_pixel * (q[1] * unframe[c] + 2.0f * q[2] * unframe[2 + c]);
    }
    const float ss = pupil_2 * m[3], st = pupil_2 * m[4], sr = pupil_2 * m[5];  // second order of s: xx, xy, yy
    const float ts = pupil_2 * m[9], tt = pupil_2 * m[10], tr = pupil_2 * m[11];  // and of t

    const int lens_rays = (int)g[7] * (int)g[7], stride = (int)g[7];
    int block = first_block.data[voxel];
    const int last_block = first_block.data[voxel + 1];
    unsigned char* value = value_out.data + first_value.data[voxel];
    const unsigned char* end = value_out.data + first_value.data[voxel + 1];
    for (int n = 0; n < reached; n += W) {
        int lens[2 * W], corner[2 * W];
        V centre_s, centre_t, first_column, first_row, box[4], middle[2];
        take_lenses(lens, corner, centre_s, centre_t, first_column, first_row);
        const M lit = pixel_box(reached - n, centre_s, centre_t, first_column, first_row, box, middle);
        if (!any(lit)) continue;
        // per lens: what its pixels need, about the middle of their box
        const V columns = box[1] - box[0] + 1.0f, rows = box[3] - box[2] + 1.0f, none = V{};
        const V middle_column = 0.5f * (columns - 1.0f), middle_row = 0.5f * (rows - 1.0f);
        V k[4], turn[4], step[4], edge[6], smears[4], part_smears[4], s, t;
        slope(middle[0], middle[1], k);
        const V area = local_frame(middle[0], middle[1], k, turn, step, edge, smears);
        // the pixel's pupil point is linear in its column and row
        const V u0 = ((1.0f + r) * centre_s - (box[0] + (0.5f - half_columns)) * pixel) / r;
        const V v0 = ((1.0f + r) * centre_t - (box[2] + (0.5f - half_rows)) * pixel) / r;
        const V u = u0 - middle_column * pupil_pixel, v = v0 - middle_row * pupil_pixel;
        position(u, v, s, t);
        s -= centre_s, t -= centre_t;
        enum { COLUMNS, FIRST_COLUMN, FIRST_ROW, COLUMN, ROW, SMEAR_A, SMEAR_B = SMEAR_A + 5, TO_A = SMEAR_B + 5, TO_B,
               AT_A, AT_B, STEP_A, STEP_B,  // of profiles
               OFFSET_S = TO_B + 1, OFFSET_T, SLOPE, FRAME = SLOPE + 4, EDGE = FRAME + 4,  // of pixels
               PARAMETERS = EDGE + 6 };
        V lens_value[PARAMETERS];
        lens_value[COLUMNS] = lit ? columns : none;
        lens_value[FIRST_COLUMN] = box[0], lens_value[FIRST_ROW] = box[2];
        lens_value[COLUMN] = middle_column, lens_value[ROW] = middle_row;
        for (int c = 0; c < 4; ++c) part_smears[c] = smears[c];
        if (parts > 1) {
            for (int c = 0; c < 6; ++c) lens_value[EDGE + c] = edge[c];
            cut_edges(edge);
            smear_widths(edge, step, part_smears);
        }
        for (int c = 0; c < 2; ++c) {
            const V wide = part_smears[c], narrow = part_smears[2 + c];
            V* e = lens_value + SMEAR_A + 5 * c;
            e[0] = 0.5f * (1.0f + wide + narrow), e[1] = 0.5f * (size(1.0f - wide) + narrow);
            e[2] = narrow, e[3] = 0.5f / narrow, e[4] = wide;
        }
        if (profiles) {
            lens_value[TO_A] = @LEVELS * area / (top_a * top_area * smears[0]);
            lens_value[TO_B] = @LEVELS / (top_b * smears[1]);
            lens_value[AT_A] = turn[0] * s + turn[1] * t, lens_value[AT_B] = turn[2] * s + turn[3] * t;
            lens_value[STEP_A] = step[0], lens_value[STEP_B] = step[3];
        } else {
            slope(u, v, k);
            lens_value[TO_A] = @LEVELS / (top_a * top_b * top_area * frame_area * part_smears[0] * part_smears[1]);
            if (parts > 1) lens_value[TO_A] /= (float)parts;
            lens_value[OFFSET_S] = s, lens_value[OFFSET_T] = t;
            for (int c = 0; c < 4; ++c) lens_value[SLOPE + c] = -pupil_pixel * k[c];
            for (int c = 0; c < 2; ++c) {
                lens_value[FRAME + c] = (1.0f - k[0]) * unframe[c] - k[1] * unframe[2 + c];
                lens_value[FRAME + 2 + c] = (1.0f - k[3]) * unframe[2 + c] - k[2] * unframe[c];
            }
        }
        const float* of_lens = (const float*)lens_value;
        for (int tile = 0; ; ++tile) {
            const float column0 = (float)(tile * @LANES);
            const M here = lens_value[COLUMNS] > column0;
            if (!any(here)) break;
            const V width = least(splat((float)@LANES), columns - column0);
            const V mid_u = u0 - (column0 + 0.5f * (width - 1.0f)) * pupil_pixel;
            const V away = root(mid_u * mid_u + v * v);
            // Layer of the microimage at the pupil's edge, from how the weights fall outwards there: where only a part
            // of a pixel lies inside the pupil, the weight that counts is that of the part's middle.
            const V far_u = size(mid_u) + 0.5f * pupil_pixel * width, far_v = size(v) + 0.5f * pupil_pixel * rows;
            const float inside = radius - 0.25f * pupil_pixel, outside = radius + 0.25f * pupil_pixel;
            const M at_rim = here & (far_u * far_u + far_v * far_v > inside * inside) & (away > 0.3f * radius);
            V layer = none;
            if (any(at_rim)) {
                const V normal_u = mid_u / away, normal_v = v / away;
                V weight[2];
                for (int c = 0; c < 2; ++c) {
                    const float at_radius = c ? outside : inside;
                    position(at_radius * normal_u, at_radius * normal_v, s, t);
                    s -= centre_s, t -= centre_t;
                    weight[c] = trapezium(turn[0] * s + turn[1] * t, smears[0], smears[2])
                        * trapezium(turn[2] * s + turn[3] * t, smears[1], smears[3]);
                }
                const V fall = 4.0f * (weight[0] - weight[1]) / most(weight[0] + weight[1], none + 1e-9f);
                layer = down(fall / @LAYER_FALL + 0.5f);
                layer = least(most(layer, none - (float)@SIDE_LAYERS), none + (float)@SIDE_LAYERS);
                layer = at_rim ? layer : none;
            }
            // rows that touch the pupil
            const float rim = radius + @RIM * pupil_pixel;
            const V near_u = most(size(mid_u) - 0.5f * pupil_pixel * width, none);
            const V high = rim * rim - near_u * near_u, half_height = root(most(high, none));
            V row_low = most(up((v0 - half_height) / pupil_pixel - 0.5f), none);
            V row_high = least(down((v0 + half_height) / pupil_pixel + 0.5f), rows - 1.0f);
            row_high = (here & (high >= 0.0f)) ? row_high : none - 1.0f;
            const V of_tile[3] = {row_low, row_high, layer};
            const float* of_lens_tile = (const float*)of_tile;
            unsigned live = 0;
            for (int l = 0; l < W; ++l) live |= (unsigned)(of_lens_tile[l] <= of_lens_tile[W + l]) << l;
            for (; live; live &= live - 1) {
                const int l = first_of(live);
                const int low = (int)of_lens_tile[l], last = (int)of_lens_tile[W + l];
                const float* p = of_lens + l;
                const int some = (int)p[W * COLUMNS] - tile * @LANES;
                const uint64_t mask = bytes_below(some);
                const float *e = p + W * SMEAR_A, *f = p + W * SMEAR_B;
                const smear smear_a = {e[0], e[W], e[2 * W], e[3 * W]};
                const smear smear_b = {f[0], f[W], f[2 * W], f[3 * W]};
                smear step_a[@MOST_STEPS], step_b[@MOST_STEPS];  // the same for the cell's steps instead of a square
                for (int q = 0; !square && q < steps; ++q) {
                    const float width = 2.0f * outline.data[2 * q], height = 2.0f * outline.data[2 * q + 1];
                    const float wide_a = e[4 * W], wide_b = f[4 * W];
                    step_a[q] = {0.5f * (width + wide_a + smear_a.narrow),
                                 0.5f * (size(width - wide_a) + smear_a.narrow), smear_a.narrow, smear_a.bend};
                    step_b[q] = {0.5f * (height + wide_b + smear_b.narrow),
                                 0.5f * (size(height - wide_b) + smear_b.narrow), smear_b.narrow, smear_b.bend};
                }
                const float to_a = p[W * TO_A];
                float part_a[@MOST_PARTS], part_b[@MOST_PARTS];
                part_a[0] = part_b[0] = 0.0f;
                if (parts > 1) {
                    const float* e = p + W * EDGE;
                    for (int part = 0; part < parts; ++part) {
                        part_a[part] = middle_of_part(part, e[0], e[W], e[2 * W]);
                        part_b[part] = middle_of_part(part, e[3 * W], e[4 * W], e[5 * W]);
                    }
                }
                const int layer_row = (int)of_lens_tile[2 * W + l] + @SIDE_LAYERS;
                const int lens_row = (lens[2 * l + 1] - lenses[1]) * @LAYERS + layer_row;
                const int lens_block = lens_row * lenses[2] + lens[2 * l] - lenses[0];
                const int ray = lens_block * lens_rays + ((int)p[W * FIRST_ROW] - corner[2 * l + 1]) * stride
                    + (int)p[W * FIRST_COLUMN] - corner[2 * l] + tile * @LANES;
                uint64_t across = 0;
                if (profiles) {
                    unsigned char level[W < 8 ? 8 : W];
                    for (int x = 0; x < 8; x += ACROSS) {
                        const V from = lane_column + (column0 + (float)x - p[W * COLUMN]);
                        const V y = smeared(p[W * AT_A] - from * p[W * STEP_A], smear_a) * to_a + 0.5f;
                        store(level + x, least(y, splat(@LEVELS)));
                    }
                    across = word(level) & mask;
                    if (!across) continue;
                }
                for (int first = low; first <= last; first += @TALLEST) {
                    const int high_row = last < first + @TALLEST - 1 ? last : first + @TALLEST - 1;
                    const int height = high_row - first + 1;
                    int top_row = -1, bottom = -1;
                    // rounding may differ from that of _measure: never write past what it counted
                    if (block >= last_block || value + (profiles ? 8 + height : 8 * height) + @LANES > end) break;
                    if (profiles) {
                        unsigned char level[@TALLEST + 16];
                        const float to_b = p[W * TO_B];
                        for (int y = 0; y < height; y += W) {
                            const V from = lane + ((float)(first + y) - p[W * ROW]);
                            const V z = smeared(p[W * AT_B] - from * p[W * STEP_B], smear_b) * to_b + 0.5f;
                            store(level + y, least(z, splat(@LEVELS)));
                        }
                        for (int y = 0; y < height; y += 8) {
                            const uint64_t w = word(level + y) & bytes_below(height - y);
                            if (!w) continue;
                            bottom = y + last_of(w) / 8;
                            if (top_row < 0) top_row = y + first_of(w) / 8;
                        }
                        if (top_row < 0) continue;
                        const int left = first_of(across) / 8, wide = last_of(across) / 8 - left + 1;
                        put_word(value, across >> (8 * left));
                        value += wide;
                        for (int y = top_row; y <= bottom; y += 8) put_word(value + y - top_row, word(level + y));
                        value += bottom - top_row + 1;
                        ray_out.data[block] = ray + (first + top_row) * stride + left;
                        width_out.data[block] = (unsigned char)wide;
                    } else {
                        for (int c = 0; c < 8; c += ACROSS) {
                            const V x = lane_column + (column0 + (float)c - p[W * COLUMN]);
                            const V s_x = p[W * OFFSET_S] + x * (p[W * SLOPE] + x * ss);
                            const V t_x = p[W * OFFSET_T] + x * (p[W * (SLOPE + 2)] + x * ts);
                            const V s_y = p[W * (SLOPE + 1)] + x * st, t_y = p[W * (SLOPE + 3)] + x * tt;
                            const V n0 = p[W * FRAME] + x * along_column[0];
                            const V n1 = p[W * (FRAME + 1)] + x * along_column[1];
                            const V n2 = p[W * (FRAME + 2)] + x * along_column[2];
                            const V n3 = p[W * (FRAME + 3)] + x * along_column[3];
                            for (int row = 0; row < height; row += DOWN) {
                                const V y = lane_row + ((float)(first + row) - p[W * ROW]);
                                const V ds = s_x + y * (s_y + y * sr), dt = t_x + y * (t_y + y * tr);
                                const V k0 = n0 + y * along_row[0], k1 = n1 + y * along_row[1];
                                const V k2 = n2 + y * along_row[2], k3 = n3 + y * along_row[3];
                                const V inverse = 1.0f / (k0 * k3 - k1 * k2);
                                const V a = (k3 * ds - k1 * dt) * inverse, b = (k0 * dt - k2 * ds) * inverse;
                                V inside_cell = none;
                                if (square && parts == 1) {
                                    inside_cell = smeared(a, smear_a) * smeared(b, smear_b);
                                } else if (square) {
                                    for (int part = 0; part < parts; ++part)
                                        inside_cell += smeared(a - part_a[part], smear_a)
                                            * smeared(b - part_b[part], smear_b);
                                } else {
                                    for (int part = 0; part < parts; ++part) {
                                        V lower = none;
                                        for (int q = 0; q < steps; ++q) {
                                            const V higher = smeared(b - part_b[part], step_b[q]);
                                            inside_cell += smeared(a - part_a[part], step_a[q]) * (higher - lower);
                                            lower = higher;
                                        }
                                    }
                                }
                                const V level = size(inverse) * inside_cell * to_a + 0.5f;
                                store(value + 8 * row + c, least(most(level, none), splat(@LEVELS)));
                            }
                        }
                        uint64_t all = 0, lit_rows = 0;
                        for (int row = 0; row < height; ++row) {
                            const uint64_t w = word(value + 8 * row) & mask;
                            all |= w;
                            lit_rows |= (uint64_t)(w != 0) << row;
                        }
                        if (!all) continue;
                        top_row = first_of(lit_rows), bottom = last_of(lit_rows);
                        const int left = first_of(all) / 8, wide = last_of(all) / 8 - left + 1;
                        const unsigned char* from = value;
                        for (int row = top_row; row <= bottom; ++row, value += wide)
                            put_word(value, (word(from + 8 * row) & mask) >> (8 * left));
                        ray_out.data[block] = ray + (first + top_row) * stride + left;
                        width_out.data[block] = (unsigned char)wide;
                    }
                    height_out.data[block] = (unsigned char)(bottom - top_row + 1);
                    ++block;
                }
            }
        }
    }
    blocks_out.data[voxel] = block - first_block.data[voxel];
    bytes_out.data[voxel] = (int)(value - (value_out.data + first_value.data[voxel]));
""")
"""Computes the blocks of voxel `voxel` where there is room for them, without gaps from block to block."""

PACK = """
    for (int k = 0; k < blocks; ++k) {
        ray_out.data[to_block + k] = ray.data[from_block + k];
        height_out.data[to_block + k] = height.data[from_block + k];
        width_out.data[to_block + k] = width.data[from_block + k];
    }
    const unsigned char* from = value.data + from_value;
    unsigned char* to = value_out.data + to_value;
    for (int k = 0; k < values; ++k) to[k] = from[k];
"""
"""Copies a voxel's blocks."""
