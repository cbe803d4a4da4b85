"""C++ of the projector's innermost loops: a voxel's blocks against the rays, one row of a block as one vector.

Both see the arguments of the functions in ``project`` that they are the text of.
"""

# A row of 8 floats or bytes in C++: a vector of the compiler on the CPU, a plain loop on a GPU. What lies in a row
# beyond its block is another block's: `within` puts 0 there.
_ROWS = """
#if defined(__CUDA_ARCH__)
    struct row { float x[8]; };
    auto zero = []() { row r; for (int i = 0; i < 8; ++i) r.x[i] = 0.0f; return r; };
    auto load = [](const float* p) { row r; for (int i = 0; i < 8; ++i) r.x[i] = p[i]; return r; };
    auto levels = [](const unsigned char* p) { row r; for (int i = 0; i < 8; ++i) r.x[i] = p[i]; return r; };
    auto within = [](row a, int width) { for (int i = width; i < 8; ++i) a.x[i] = 0.0f; return a; };
    auto add = [](row a, row b, float c) { for (int i = 0; i < 8; ++i) a.x[i] += b.x[i] * c; return a; };
    auto add_product = [](row a, row b, row c) { for (int i = 0; i < 8; ++i) a.x[i] += b.x[i] * c.x[i]; return a; };
    auto sum = [](row a) {
        return ((a.x[0] + a.x[4]) + (a.x[1] + a.x[5])) + ((a.x[2] + a.x[6]) + (a.x[3] + a.x[7]));
    };
#else
    typedef float row __attribute__((vector_size(32), aligned(4)));
    typedef unsigned char bytes __attribute__((vector_size(8), aligned(1)));
    typedef int lanes __attribute__((vector_size(32)));
    auto zero = []() { return row{0, 0, 0, 0, 0, 0, 0, 0}; };
    auto load = [](const float* p) { return *(const row*)p; };
    auto levels = [](const unsigned char* p) { return __builtin_convertvector(*(const bytes*)p, row); };
    auto within = [](row a, int width) { return (lanes{0, 1, 2, 3, 4, 5, 6, 7} < width) ? a : row{}; };
    auto add = [](row a, row b, float c) { return a + b * c; };
    auto add_product = [](row a, row b, row c) { return a + b * c; };
    auto sum = [](row a) { return ((a[0] + a[4]) + (a[1] + a[5])) + ((a[2] + a[6]) + (a[3] + a[7])); };
#endif
"""

GATHER = (
    _ROWS
    + """
    const unsigned char* level = levels_in.data + first_value;
    row total = zero();
    for (int block = first; block < last; ++block) {
        const float* at = rays.data + ray.data[block];
        const int rows = height.data[block], columns = width.data[block];
        row even = zero(), odd = zero();
        int k = 0;
        if (profiles) {
            const row across = within(levels(level), columns);
            level += columns;
            for (; k < rows; ++k, at += stride) even = add(even, load(at), (float)level[k]);
            level += rows;
            total = add_product(total, even, across);
        } else {
            for (; k + 1 < rows; k += 2, at += 2 * stride, level += 2 * columns) {
                even = add_product(even, load(at), levels(level));
                odd = add_product(odd, load(at + stride), levels(level + columns));
            }
            if (k < rows) {
                even = add_product(even, load(at), levels(level));
                level += columns;
            }
            total = add(total, within(add(even, odd, 1.0f), columns), 1.0f);
        }
    }
    return sum(total);
"""
)

SCATTER = (
    _ROWS
    + """
#if !defined(__CUDA_ARCH__)  // rays of its own: not for two threads at once
    const unsigned char* level = levels_in.data + first_value;
    for (int block = first; block < last; ++block) {
        float* at = rays_out.data + ray.data[block];
        const int rows = height.data[block], columns = width.data[block];
        const row light = within(zero() + intensity, columns);
        int k = 0;
        if (profiles) {
            const row across = levels(level) * light;
            level += columns;
            for (; k + 1 < rows; k += 2, at += 2 * stride) {  // load two rows, then store two
                const row even = add(load(at), across, (float)level[k]);
                const row odd = add(load(at + stride), across, (float)level[k + 1]);
                *(row*)at = even;
                *(row*)(at + stride) = odd;
            }
            if (k < rows) *(row*)at = add(load(at), across, (float)level[k]);
            level += rows;
        } else {
            for (; k + 1 < rows; k += 2, at += 2 * stride, level += 2 * columns) {
                const row even = add_product(load(at), levels(level), light);
                const row odd = add_product(load(at + stride), levels(level + columns), light);
                *(row*)at = even;
                *(row*)(at + stride) = odd;
            }
            if (k < rows) {
                *(row*)at = add_product(load(at), levels(level), light);
                level += columns;
            }
        }
    }
#endif
"""
)
