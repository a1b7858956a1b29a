/* The inner loops of rendering in single precision: what numpy takes several passes and many short calls for.
   Plain C99 without Python's headers: `inner_loops.py` loads it and calls it without Python's lock, so that two
   threads run two of these at a time. Each loop has a counterpart in numpy that does the same up to rounding.
   Arrays are contiguous where nothing else is said; complex numbers are their real and imaginary parts, one after
   the other. Nothing is checked here: the callers do that. */

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(_WIN32)
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif

/* One library for all processors of a kind: when it is loaded, the widest instructions that there are are chosen. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#pragma GCC optimize("O3")
#if __GNUC__ >= 12
#define WIDE __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define WIDE __attribute__((target_clones("avx512f", "avx2", "default")))
#endif
#else
#define WIDE
#endif

/* INDEPENDENT: what one turn of the loop that follows writes, no other reads. */
#if defined(_MSC_VER)
#define RESTRICT __restrict
#define INLINE static __forceinline
#define INDEPENDENT __pragma(loop(ivdep))
#elif defined(__clang__)
#define RESTRICT restrict
#define INLINE static inline __attribute__((always_inline))
#define INDEPENDENT _Pragma("clang loop vectorize(assume_safety)")
#elif defined(__GNUC__)
#define RESTRICT restrict
#define INLINE static inline __attribute__((always_inline))
#define INDEPENDENT _Pragma("GCC ivdep")
#else
#define RESTRICT restrict
#define INLINE static inline
#define INDEPENDENT
#endif

enum { LANES = 16 }; /* sums that run side by side, so that a processor can add them up at once */

/* Linkers on Windows ask for this; it is loaded as a library, not as a module of Python's. */
EXPORTED void *PyInit__inner_loops(void) { return NULL; }

/* To be raised whenever a function's arguments or meaning change. */
EXPORTED int wavefocus_version(void) { return 2; }

/* What is seen of some samples: magnitudes as the integers that their bits are, and energies, in lanes. */
struct seen {
    uint32_t most[LANES], fewest[LANES];
    double sums[LANES];
};

INLINE void look_at(const float *RESTRICT in, struct seen *seen)
{
    uint32_t bits[LANES];
    memcpy(bits, in, sizeof bits);
    for (int lane = 0; lane < LANES; lane++) {
        const uint32_t magnitude = bits[lane] & 0x7fffffffu, below = magnitude - 1u;
        seen->most[lane] = magnitude > seen->most[lane] ? magnitude : seen->most[lane];
        seen->fewest[lane] = below < seen->fewest[lane] ? below : seen->fewest[lane];
    }
    for (int lane = 0; lane < LANES; lane++)
        seen->sums[lane] += (double)in[lane] * (double)in[lane];
}

/* Looks at rows (actuators, taps), each at an address of its own. Of each: the largest magnitude as the integer
   that its bits are (0x7f800000 or more: not finite), the smallest one above zero less 1 (the largest integer
   where all are zero), and for each actuator the energies, summed up in double precision, of its first `used` taps
   and, after those of all actuators, of its others. */
WIDE EXPORTED void wavefocus_look(const uintptr_t *RESTRICT rows, ptrdiff_t count, ptrdiff_t actuators, ptrdiff_t taps,
                                  ptrdiff_t used, uint32_t *RESTRICT largest, uint32_t *RESTRICT least,
                                  double *RESTRICT energies)
{
    for (ptrdiff_t row = 0; row < count; row++) {
        struct seen seen;
        memset(seen.most, 0, sizeof seen.most);
        memset(seen.fewest, 0xff, sizeof seen.fewest);
        for (ptrdiff_t actuator = 0; actuator < actuators; actuator++)
            for (int part = 0; part < 2; part++) {
                const float *RESTRICT in = (const float *)rows[row] + actuator * taps + (part ? used : 0);
                const ptrdiff_t samples = part ? taps - used : used, whole = samples - samples % LANES;
                memset(seen.sums, 0, sizeof seen.sums);
                for (ptrdiff_t i = 0; i < whole; i += LANES)
                    look_at(in + i, &seen);
                if (whole < samples) {
                    float rest[LANES] = {0.0f};
                    memcpy(rest, in + whole, (size_t)(samples - whole) * sizeof *rest);
                    look_at(rest, &seen);
                }
                double sum = 0.0;
                for (int lane = 0; lane < LANES; lane++)
                    sum += seen.sums[lane];
                energies[(2 * row + part) * actuators + actuator] = sum;
            }
        for (int lane = 1; lane < LANES; lane++) {
            seen.most[0] = seen.most[lane] > seen.most[0] ? seen.most[lane] : seen.most[0];
            seen.fewest[0] = seen.fewest[lane] < seen.fewest[0] ? seen.fewest[lane] : seen.fewest[0];
        }
        largest[row] = seen.most[0];
        least[row] = seen.fewest[0];
    }
}

/* --- transforms of rows -----------------------------------------------------------------------------------------

   Several actuators are transformed side by side, one in each lane: number n of all of them is `lanes` real parts and
   as many imaginary ones. Even and odd samples make one complex signal of half the length, which Stockham's algorithm
   transforms: a pass for each factor of the length, from one buffer to the other, after which all is in order
   (C. Van Loan, Computational Frameworks for the Fast Fourier Transform, 1992, section 1.7). */

/* Of `count` numbers a pass makes `rest` groups of butterflies, `stride` in each, and the next one continues with a
   stride that is greater by the factor. `turns` are those of all numbers. */

#define EACH_LANE INDEPENDENT for (int lane = 0; lane < lanes; lane++)

INLINE void pass_2(const int lanes, ptrdiff_t rest, ptrdiff_t stride, const float *RESTRICT turns,
                   const float *RESTRICT in, float *RESTRICT out)
{
    const ptrdiff_t size = 2 * lanes, far = stride * rest * size, next = stride * size;
    for (ptrdiff_t p = 0; p < rest; p++) {
        const float *RESTRICT turn = turns + 2 * p * stride;
        for (ptrdiff_t q = 0; q < stride; q++) {
            const float *RESTRICT a = in + (q + stride * p) * size, *RESTRICT b = a + far;
            float *RESTRICT to = out + (q + 2 * stride * p) * size, *RESTRICT to_1 = to + next;
            EACH_LANE {
                const float re = a[lane] - b[lane], im = a[lanes + lane] - b[lanes + lane];
                to[lane] = a[lane] + b[lane];
                to[lanes + lane] = a[lanes + lane] + b[lanes + lane];
                to_1[lane] = re * turn[0] - im * turn[1];
                to_1[lanes + lane] = re * turn[1] + im * turn[0];
            }
        }
    }
}

INLINE void pass_3(const int lanes, ptrdiff_t rest, ptrdiff_t stride, const float *RESTRICT turns,
                   const float *RESTRICT in, float *RESTRICT out)
{
    const float sine = 0.866025403784438647f;
    const ptrdiff_t size = 2 * lanes, far = stride * rest * size, next = stride * size;
    for (ptrdiff_t p = 0; p < rest; p++) {
        const float *RESTRICT turn_1 = turns + 2 * p * stride, *RESTRICT turn_2 = turns + 4 * p * stride;
        for (ptrdiff_t q = 0; q < stride; q++) {
            const float *RESTRICT a = in + (q + stride * p) * size, *RESTRICT b = a + far, *RESTRICT c = b + far;
            float *RESTRICT to = out + (q + 3 * stride * p) * size;
            float *RESTRICT to_1 = to + next, *RESTRICT to_2 = to_1 + next;
            EACH_LANE {
                const float sum_re = b[lane] + c[lane], sum_im = b[lanes + lane] + c[lanes + lane];
                const float turned_re = sine * (b[lanes + lane] - c[lanes + lane]);
                const float turned_im = sine * (c[lane] - b[lane]);
                const float half_re = a[lane] - 0.5f * sum_re, half_im = a[lanes + lane] - 0.5f * sum_im;
                const float re_1 = half_re + turned_re, im_1 = half_im + turned_im;
                const float re_2 = half_re - turned_re, im_2 = half_im - turned_im;
                to[lane] = a[lane] + sum_re;
                to[lanes + lane] = a[lanes + lane] + sum_im;
                to_1[lane] = re_1 * turn_1[0] - im_1 * turn_1[1];
                to_1[lanes + lane] = re_1 * turn_1[1] + im_1 * turn_1[0];
                to_2[lane] = re_2 * turn_2[0] - im_2 * turn_2[1];
                to_2[lanes + lane] = re_2 * turn_2[1] + im_2 * turn_2[0];
            }
        }
    }
}

INLINE void pass_4(const int lanes, ptrdiff_t rest, ptrdiff_t stride, const float *RESTRICT turns,
                   const float *RESTRICT in, float *RESTRICT out)
{
    const ptrdiff_t size = 2 * lanes, far = stride * rest * size, next = stride * size;
    for (ptrdiff_t p = 0; p < rest; p++) {
        const float *RESTRICT turn_1 = turns + 2 * p * stride, *RESTRICT turn_2 = turns + 4 * p * stride;
        const float *RESTRICT turn_3 = turns + 6 * p * stride;
        for (ptrdiff_t q = 0; q < stride; q++) {
            const float *RESTRICT a = in + (q + stride * p) * size, *RESTRICT b = a + far, *RESTRICT c = b + far;
            const float *RESTRICT d = c + far;
            float *RESTRICT to = out + (q + 4 * stride * p) * size, *RESTRICT to_1 = to + next;
            float *RESTRICT to_2 = to_1 + next, *RESTRICT to_3 = to_2 + next;
            EACH_LANE {
                const float even_re = a[lane] + c[lane], even_im = a[lanes + lane] + c[lanes + lane];
                const float gap_re = a[lane] - c[lane], gap_im = a[lanes + lane] - c[lanes + lane];
                const float odd_re = b[lane] + d[lane], odd_im = b[lanes + lane] + d[lanes + lane];
                const float turned_re = b[lanes + lane] - d[lanes + lane], turned_im = d[lane] - b[lane];
                const float re_1 = gap_re + turned_re, im_1 = gap_im + turned_im;
                const float re_2 = even_re - odd_re, im_2 = even_im - odd_im;
                const float re_3 = gap_re - turned_re, im_3 = gap_im - turned_im;
                to[lane] = even_re + odd_re;
                to[lanes + lane] = even_im + odd_im;
                to_1[lane] = re_1 * turn_1[0] - im_1 * turn_1[1];
                to_1[lanes + lane] = re_1 * turn_1[1] + im_1 * turn_1[0];
                to_2[lane] = re_2 * turn_2[0] - im_2 * turn_2[1];
                to_2[lanes + lane] = re_2 * turn_2[1] + im_2 * turn_2[0];
                to_3[lane] = re_3 * turn_3[0] - im_3 * turn_3[1];
                to_3[lanes + lane] = re_3 * turn_3[1] + im_3 * turn_3[0];
            }
        }
    }
}

INLINE void pass_5(const int lanes, ptrdiff_t rest, ptrdiff_t stride, const float *RESTRICT turns,
                   const float *RESTRICT in, float *RESTRICT out)
{
    const float cos_1 = 0.309016994374947424f, cos_2 = -0.809016994374947424f;
    const float sin_1 = 0.951056516295153572f, sin_2 = 0.587785252292473129f;
    const ptrdiff_t size = 2 * lanes, far = stride * rest * size, next = stride * size;
    for (ptrdiff_t p = 0; p < rest; p++) {
        const float *RESTRICT turn_1 = turns + 2 * p * stride, *RESTRICT turn_2 = turns + 4 * p * stride;
        const float *RESTRICT turn_3 = turns + 6 * p * stride, *RESTRICT turn_4 = turns + 8 * p * stride;
        for (ptrdiff_t q = 0; q < stride; q++) {
            const float *RESTRICT a = in + (q + stride * p) * size, *RESTRICT b = a + far, *RESTRICT c = b + far;
            const float *RESTRICT d = c + far, *RESTRICT e = d + far;
            float *RESTRICT to = out + (q + 5 * stride * p) * size, *RESTRICT to_1 = to + next;
            float *RESTRICT to_2 = to_1 + next, *RESTRICT to_3 = to_2 + next, *RESTRICT to_4 = to_3 + next;
            EACH_LANE {
                const float near_re = b[lane] + e[lane], near_im = b[lanes + lane] + e[lanes + lane];
                const float apart_re = b[lane] - e[lane], apart_im = b[lanes + lane] - e[lanes + lane];
                const float mid_re = c[lane] + d[lane], mid_im = c[lanes + lane] + d[lanes + lane];
                const float gap_re = c[lane] - d[lane], gap_im = c[lanes + lane] - d[lanes + lane];
                const float one_re = a[lane] + cos_1 * near_re + cos_2 * mid_re;
                const float one_im = a[lanes + lane] + cos_1 * near_im + cos_2 * mid_im;
                const float two_re = a[lane] + cos_2 * near_re + cos_1 * mid_re;
                const float two_im = a[lanes + lane] + cos_2 * near_im + cos_1 * mid_im;
                const float first_re = sin_1 * apart_im + sin_2 * gap_im;
                const float first_im = -sin_1 * apart_re - sin_2 * gap_re;
                const float second_re = sin_2 * apart_im - sin_1 * gap_im;
                const float second_im = -sin_2 * apart_re + sin_1 * gap_re;
                const float re_1 = one_re + first_re, im_1 = one_im + first_im;
                const float re_2 = two_re + second_re, im_2 = two_im + second_im;
                const float re_3 = two_re - second_re, im_3 = two_im - second_im;
                const float re_4 = one_re - first_re, im_4 = one_im - first_im;
                to[lane] = a[lane] + near_re + mid_re;
                to[lanes + lane] = a[lanes + lane] + near_im + mid_im;
                to_1[lane] = re_1 * turn_1[0] - im_1 * turn_1[1];
                to_1[lanes + lane] = re_1 * turn_1[1] + im_1 * turn_1[0];
                to_2[lane] = re_2 * turn_2[0] - im_2 * turn_2[1];
                to_2[lanes + lane] = re_2 * turn_2[1] + im_2 * turn_2[0];
                to_3[lane] = re_3 * turn_3[0] - im_3 * turn_3[1];
                to_3[lanes + lane] = re_3 * turn_3[1] + im_3 * turn_3[0];
                to_4[lane] = re_4 * turn_4[0] - im_4 * turn_4[1];
                to_4[lanes + lane] = re_4 * turn_4[1] + im_4 * turn_4[0];
            }
        }
    }
}

/* A transform of real signals. */
struct transform {
    ptrdiff_t length;
    const int64_t *factors;           /* of half of it: 2, 3, 4 or 5, ended by 1 */
    const float *turns, *half_turns;  /* exp(-2 pi i n / (length / 2)) and exp(-2 pi i n / length), n < length / 2 */
};

/* Transforms half as many complex numbers as a signal has samples, in each lane, by a pass for each of their factors;
   returns in which buffer they are. */
INLINE float *transform_all(const int lanes, const struct transform *transform, float *in, float *out)
{
    const ptrdiff_t count = transform->length / 2;
    const float *turns = transform->turns;
    ptrdiff_t stride = 1;
    for (const int64_t *by = transform->factors; *by > 1; by++) {
        const ptrdiff_t rest = count / stride / (ptrdiff_t)*by;
        switch (*by) {
        case 2: pass_2(lanes, rest, stride, turns, in, out); break;
        case 3: pass_3(lanes, rest, stride, turns, in, out); break;
        case 4: pass_4(lanes, rest, stride, turns, in, out); break;
        default: pass_5(lanes, rest, stride, turns, in, out); break;
        }
        float *other = in;
        in = out;
        out = other;
        stride *= (ptrdiff_t)*by;
    }
    return in;
}

/* Bins n and half - n of what even and odd samples made of one complex signal, `a` and `b`, are those bins of
   both, and make bins n (re, im) and half - n (re_too, im_too) of the real signal. */
#define UNPACK(a, b)                                                                                                   \
    const float even_re = 0.5f * (a[lane] + b[lane]), even_im = 0.5f * (a[lanes + lane] - b[lanes + lane]);            \
    const float odd_re = a[lanes + lane] + b[lanes + lane], odd_im = b[lane] - a[lane];                                \
    const float turned_re = odd_re * turn_re - odd_im * turn_im, turned_im = odd_re * turn_im + odd_im * turn_re;      \
    const float re = even_re + turned_re, im = even_im + turned_im;                                                    \
    const float re_too = even_re - turned_re, im_too = turned_im - even_im;

/* What all rows of a call have in common. */
struct shape {
    struct transform transform;
    ptrdiff_t taps, used;             /* of a row, and how many of them are transformed */
    const int64_t *actuators;         /* which actuators */
    ptrdiff_t heard;                  /* how many */
    ptrdiff_t low, high;              /* bins low to high - 1 are kept */
    ptrdiff_t conjugate;              /* whether their conjugates are */
};

/* Some actuators of one row, from `first` of those heard; there may be fewer than lanes. */
INLINE void transform_some(const int lanes, const struct shape *shape, const float *RESTRICT row, float factor,
                           ptrdiff_t first, float *RESTRICT room, float *RESTRICT kept, float *RESTRICT squares)
{
    const ptrdiff_t size = 2 * lanes, half = shape->transform.length / 2, pairs = shape->used / 2;
    float *in = room, *out = room + half * size;
    const float *from[8];
    EACH_LANE from[lane] = row + shape->actuators[first + lane < shape->heard ? first + lane : first] * shape->taps;
    for (ptrdiff_t n = 0; n < pairs; n++)
        EACH_LANE {
            in[n * size + lane] = factor * from[lane][2 * n];
            in[n * size + lanes + lane] = factor * from[lane][2 * n + 1];
        }
    memset(in + pairs * size, 0, (size_t)((half - pairs) * size) * sizeof *in);
    if (shape->used % 2)
        EACH_LANE in[pairs * size + lane] = factor * from[lane][2 * pairs];
    for (ptrdiff_t n = 0; n <= pairs && n < half; n++)
        for (int lane = (int)(shape->heard - first); lane < lanes; lane++)
            in[n * size + lane] = in[n * size + lanes + lane] = 0.0f;
    in = transform_all(lanes, &shape->transform, in, out);
    const ptrdiff_t left = shape->heard - first;
    const float sign = shape->conjugate ? -1.0f : 1.0f;
    float aside[3][16];
    for (ptrdiff_t bin = 0; 2 * bin <= half; bin++) {
        const ptrdiff_t mirrored = half - bin;
        const float *RESTRICT a = in + bin * size, *RESTRICT b = in + (bin ? mirrored : 0) * size;
        const float *RESTRICT turn = shape->transform.half_turns + 2 * bin;
        const float turn_re = 0.5f * turn[0], turn_im = 0.5f * turn[1];
        const int wanted = bin >= shape->low && bin < shape->high && left >= lanes;
        const int wanted_too = mirrored >= shape->low && mirrored < shape->high && left >= lanes;
        float *RESTRICT to = wanted ? kept + 2 * ((bin - shape->low) * shape->heard + first) : aside[0];
        float *RESTRICT to_too = wanted_too ? kept + 2 * ((mirrored - shape->low) * shape->heard + first) : aside[1];
        float *RESTRICT sums = squares + 8 * bin;
        float *RESTRICT sums_too = 2 * bin < half ? squares + 8 * mirrored : aside[2];
        EACH_LANE {
            UNPACK(a, b)
            to[2 * lane] = re;
            to[2 * lane + 1] = sign * im;
            to_too[2 * lane] = re_too;
            to_too[2 * lane + 1] = sign * im_too;
            sums[lane] += re * re + im * im;
            sums_too[lane] += re_too * re_too + im_too * im_too;
        }
        if (left < lanes) {
            const size_t some = 2 * (size_t)left * sizeof *kept;
            if (bin >= shape->low && bin < shape->high)
                memcpy(kept + 2 * ((bin - shape->low) * shape->heard + first), aside[0], some);
            if (mirrored >= shape->low && mirrored < shape->high)
                memcpy(kept + 2 * ((mirrored - shape->low) * shape->heard + first), aside[1], some);
        }
    }
}

/* Rows, each at an address of its own and times a factor of its own, transformed: the bins that are kept (bins,
   actuators), at an address for each row, and the squares of the magnitudes of all bins, added up over the actuators,
   (rows, bins). `room` is for 16 * length + 8 * (length / 2 + 1) numbers. */
WIDE EXPORTED void wavefocus_transform(const uintptr_t *RESTRICT rows, const float *RESTRICT scales, ptrdiff_t count,
                                       const struct shape *RESTRICT shape, float *RESTRICT room,
                                       const uintptr_t *RESTRICT kept, float *RESTRICT squares)
{
    const ptrdiff_t bins = shape->transform.length / 2 + 1;
    float *RESTRICT eights = room + 16 * shape->transform.length;
    for (ptrdiff_t row = 0; row < count; row++) {
        const float *in = (const float *)rows[row];
        float *to = (float *)kept[row];
        memset(eights, 0, 8 * (size_t)bins * sizeof *eights);
        ptrdiff_t first = 0;
        for (; first + 4 < shape->heard; first += 8)
            transform_some(8, shape, in, scales[row], first, room, to, eights);
        if (first < shape->heard)
            transform_some(4, shape, in, scales[row], first, room, to, eights);
        for (ptrdiff_t bin = 0; bin < bins; bin++) {
            const float *RESTRICT of = eights + 8 * bin;
            squares[row * bins + bin] = of[0] + of[1] + of[2] + of[3] + of[4] + of[5] + of[6] + of[7];
        }
    }
}

/* --- windows ----------------------------------------------------------------------------------------------------- */

/* What all windows of a call have in common. */
struct windows {
    struct transform transform;
    ptrdiff_t low, high;              /* bins low to high - 1 are kept */
    const int32_t *segment;           /* of each bin */
    ptrdiff_t segments;
    ptrdiff_t band_low, band_high;    /* bins whose energy is told apart */
    /* Runs of samples: where they begin among `values` and in their window, how many they are, and their factors. */
    const double *values;
    const int64_t *begin, *start, *count;
    const double *factor;
};

enum { WINDOWS = 8 }; /* windows that are transformed side by side */

/* Windows, each the sum of its runs, bounds[2 w] to bounds[2 w + 1] - 1 for window w, no two of which meet,
   transformed. The bins that are kept go to `kept` (windows, bins kept), the largest square of a magnitude in each
   segment to `largest` (windows, segments), and to `energies` (windows, 3) those of the samples, of the bins of
   the band and of all bins. `room` is for 16 * length + 8 * segments numbers. */
WIDE EXPORTED void wavefocus_windows(const struct windows *RESTRICT shape, const int64_t *RESTRICT bounds,
                                     ptrdiff_t windows, float *RESTRICT room, float *RESTRICT kept,
                                     float *RESTRICT largest, double *RESTRICT energies)
{
    const int lanes = WINDOWS;
    const ptrdiff_t size = 2 * lanes, half = shape->transform.length / 2, bins = shape->high - shape->low;
    float *RESTRICT peaks = room + 16 * shape->transform.length;
    for (ptrdiff_t first = 0; first < windows; first += lanes) {
        const ptrdiff_t some = windows - first < lanes ? windows - first : lanes;
        double band[WINDOWS] = {0.0}, all[WINDOWS] = {0.0};
        float *in = room;
        memset(in, 0, (size_t)(half * size) * sizeof *in);
        memset(peaks, 0, (size_t)(shape->segments * lanes) * sizeof *peaks);
        for (ptrdiff_t window = 0; window < some; window++) {
            double energy = 0.0;
            for (int64_t run = bounds[2 * (first + window)]; run < bounds[2 * (first + window) + 1]; run++) {
                const double *RESTRICT from = shape->values + shape->begin[run];
                for (int64_t i = 0; i < shape->count[run]; i++) {
                    const int64_t at = shape->start[run] + i;
                    const float value = (float)(from[i] * shape->factor[run]);
                    in[at / 2 * size + at % 2 * lanes + window] = value;
                    energy += (double)value * (double)value;
                }
            }
            energies[3 * (first + window)] = energy;
        }
        in = transform_all(lanes, &shape->transform, in, in + half * size);
        for (ptrdiff_t bin = 0; 2 * bin <= half; bin++) {
            const ptrdiff_t mirrored = half - bin;
            const float *RESTRICT a = in + bin * size, *RESTRICT b = in + (bin ? mirrored : 0) * size;
            const float *RESTRICT turn = shape->transform.half_turns + 2 * bin;
            const float turn_re = 0.5f * turn[0], turn_im = 0.5f * turn[1];
            /* These two may be the same. */
            float *peak = peaks + shape->segment[bin] * lanes, *peak_too = peaks + shape->segment[mirrored] * lanes;
            float real[WINDOWS], imaginary[WINDOWS], squares[WINDOWS];
            float real_too[WINDOWS], imaginary_too[WINDOWS], squares_too[WINDOWS];
            EACH_LANE {
                UNPACK(a, b)
                real[lane] = re;
                imaginary[lane] = im;
                squares[lane] = re * re + im * im;
                real_too[lane] = re_too;
                imaginary_too[lane] = im_too;
                squares_too[lane] = re_too * re_too + im_too * im_too;
            }
            EACH_LANE peak[lane] = squares[lane] > peak[lane] ? squares[lane] : peak[lane];
            EACH_LANE peak_too[lane] = squares_too[lane] > peak_too[lane] ? squares_too[lane] : peak_too[lane];
            EACH_LANE all[lane] += (double)squares[lane];
            if (bin < mirrored)
                EACH_LANE all[lane] += (double)squares_too[lane];
            if (bin >= shape->band_low && bin < shape->band_high)
                EACH_LANE band[lane] += (double)squares[lane];
            if (bin < mirrored && mirrored >= shape->band_low && mirrored < shape->band_high)
                EACH_LANE band[lane] += (double)squares_too[lane];
            if (bin >= shape->low && bin < shape->high)
                for (ptrdiff_t window = 0; window < some; window++) {
                    float *RESTRICT to = kept + 2 * ((first + window) * bins + bin - shape->low);
                    to[0] = real[window];
                    to[1] = imaginary[window];
                }
            if (mirrored >= shape->low && mirrored < shape->high)
                for (ptrdiff_t window = 0; window < some; window++) {
                    float *RESTRICT to = kept + 2 * ((first + window) * bins + mirrored - shape->low);
                    to[0] = real_too[window];
                    to[1] = imaginary_too[window];
                }
        }
        for (ptrdiff_t window = 0; window < some; window++) {
            for (ptrdiff_t segment = 0; segment < shape->segments; segment++)
                largest[(first + window) * shape->segments + segment] = peaks[segment * lanes + window];
            energies[3 * (first + window) + 1] = band[window];
            energies[3 * (first + window) + 2] = all[window];
        }
    }
}

/* --- blocks ------------------------------------------------------------------------------------------------------ */

/* What all blocks of a call have in common. */
struct back {
    struct transform transform;       /* its length is that of a block */
    ptrdiff_t actuators;
    ptrdiff_t low, high;              /* bins low to high - 1 are computed, the others are zero */
    const float *turn;                /* what these are multiplied with */
};

/* The sum over some rows of their spectra (bins, actuators), each at an address of its own, times one window
   (bins) each; and all of it times `turn`. `sums` is for 4 numbers per actuator. */
INLINE void sum_rows(const struct back *back, const uintptr_t *RESTRICT rows, const float *RESTRICT windows,
                     ptrdiff_t count, float *RESTRICT sums, float *RESTRICT out)
{
    const ptrdiff_t parts = 2 * back->actuators, bins = back->high - back->low, window = 2 * bins;
    float *RESTRICT by_real = sums, *RESTRICT by_imaginary = sums + parts;
    for (ptrdiff_t bin = 0; bin < bins; bin++) {
        const float *RESTRICT weight = windows + 2 * bin;
        float *RESTRICT to = out + bin * parts;
        ptrdiff_t row = count % 2;
        if (row) {
            const float *RESTRICT in = (const float *)rows[0] + bin * parts;
            const float re = weight[0], im = weight[1];
            INDEPENDENT for (ptrdiff_t i = 0; i < parts; i++) {
                by_real[i] = re * in[i];
                by_imaginary[i] = im * in[i];
            }
            weight += window;
        } else
            memset(sums, 0, 2 * (size_t)parts * sizeof *sums);
        /* Two at a time: sums are fetched and put back half as often. */
        for (; row < count; row += 2, weight += 2 * window) {
            const float *RESTRICT in = (const float *)rows[row] + bin * parts;
            const float *RESTRICT next = (const float *)rows[row + 1] + bin * parts;
            const float re = weight[0], im = weight[1], next_re = weight[window], next_im = weight[window + 1];
            INDEPENDENT for (ptrdiff_t i = 0; i < parts; i++) {
                by_real[i] += re * in[i] + next_re * next[i];
                by_imaginary[i] += im * in[i] + next_im * next[i];
            }
        }
        const float turn_re = back->turn[2 * bin], turn_im = back->turn[2 * bin + 1];
        INDEPENDENT for (ptrdiff_t i = 0; i < parts; i += 2) {
            const float re = by_real[i] - by_imaginary[i + 1], im = by_real[i + 1] + by_imaginary[i];
            to[i] = re * turn_re - im * turn_im;
            to[i + 1] = re * turn_im + im * turn_re;
        }
    }
}

/* Spectra (bins computed, actuators) of a block back to time, some actuators from `first`; there may be fewer than
   lanes. `out` is (actuators, length). Returns the energy of the samples. */
INLINE double transform_back(const int lanes, const struct back *back, const float *RESTRICT spectra, ptrdiff_t first,
                           float *RESTRICT room, float *RESTRICT out)
{
    const ptrdiff_t size = 2 * lanes, half = back->transform.length / 2;
    const ptrdiff_t left = back->actuators - first < lanes ? back->actuators - first : lanes;
    const float scale = 1.0f / (float)half;
    float *in = room, silence[16] = {0.0f}, one[16] = {0.0f}, other[16] = {0.0f};
    for (ptrdiff_t bin = 0; bin < half; bin++) {
        /* Even and odd samples have the spectra (X[n] +- conj X[half - n]) / 2, the odd ones turned. */
        const ptrdiff_t mirrored = half - bin;
        const float *a = silence, *b = silence;
        if (bin >= back->low && bin < back->high)
            a = spectra + 2 * ((bin - back->low) * back->actuators + first);
        if (mirrored >= back->low && mirrored < back->high)
            b = spectra + 2 * ((mirrored - back->low) * back->actuators + first);
        if (left < lanes || !bin) {
            memcpy(one, a, 2 * (size_t)left * sizeof *a);
            memcpy(other, b, 2 * (size_t)left * sizeof *b);
            a = one;
            b = other;
            if (!bin) /* The first bin and the last of a real signal are real. */
                EACH_LANE one[2 * lane + 1] = other[2 * lane + 1] = 0.0f;
        }
        const float turn_re = back->transform.half_turns[2 * bin], turn_im = -back->transform.half_turns[2 * bin + 1];
        float *RESTRICT to = in + bin * size;
        EACH_LANE {
            const float even_re = a[2 * lane] + b[2 * lane], even_im = a[2 * lane + 1] - b[2 * lane + 1];
            const float gap_re = a[2 * lane] - b[2 * lane], gap_im = a[2 * lane + 1] + b[2 * lane + 1];
            const float odd_re = gap_re * turn_re - gap_im * turn_im, odd_im = gap_re * turn_im + gap_im * turn_re;
            /* The conjugate of even + i odd: a transform forwards makes the conjugate of what one backwards makes. */
            to[lane] = 0.5f * scale * (even_re - odd_im);
            to[lanes + lane] = -0.5f * scale * (even_im + odd_re);
        }
    }
    in = transform_all(lanes, &back->transform, in, in + half * size);
    float sums[8] = {0.0f};
    double energy = 0.0;
    for (ptrdiff_t n = 0; n < half; n++)
        EACH_LANE sums[lane] += in[n * size + lane] * in[n * size + lane]
            + in[n * size + lanes + lane] * in[n * size + lanes + lane];
    for (ptrdiff_t lane = 0; lane < left; lane++) {
        float *RESTRICT to = out + (first + lane) * back->transform.length;
        energy += (double)sums[lane];
        for (ptrdiff_t n = 0; n < half; n++) {
            to[2 * n] = in[n * size + lane];
            to[2 * n + 1] = -in[n * size + lanes + lane];
        }
    }
    return energy;
}

/* Blocks (actuators, length) in time: the sums over their rows, bounds[b] to bounds[b + 1] - 1 for block b, of
   rows times windows, transformed back; and their energies. `room` is for 16 * length + 2 * actuators * (bins
   computed + 2) numbers. */
WIDE EXPORTED void wavefocus_blocks(const uintptr_t *RESTRICT rows, const float *RESTRICT windows,
                                    const int64_t *RESTRICT bounds, ptrdiff_t blocks,
                                    const struct back *RESTRICT back, float *RESTRICT room, float *RESTRICT out,
                                    double *RESTRICT energies)
{
    const ptrdiff_t window = 2 * (back->high - back->low);
    float *RESTRICT sums = room + 16 * back->transform.length, *RESTRICT spectra = sums + 4 * back->actuators;
    for (ptrdiff_t block = 0; block < blocks; block++, out += back->actuators * back->transform.length) {
        const ptrdiff_t begin = (ptrdiff_t)bounds[block], count = (ptrdiff_t)bounds[block + 1] - begin;
        energies[block] = 0.0;
        if (!count) {
            memset(out, 0, (size_t)(back->actuators * back->transform.length) * sizeof *out);
            continue;
        }
        sum_rows(back, rows + begin, windows + begin * window, count, sums, spectra);
        ptrdiff_t first = 0;
        for (; first + 4 < back->actuators; first += 8)
            energies[block] += transform_back(8, back, spectra, first, room, out);
        if (first < back->actuators)
            energies[block] += transform_back(4, back, spectra, first, room, out);
    }
}

/* --- sums in double precision ------------------------------------------------------------------------------------ */

enum { CHUNK = 64 }; /* bins of some rows that stay in the cache of one core while all groups are summed */

/* For each group the sum over its rows, bounds[g] to bounds[g + 1] - 1, of their spectra (bins, actuators), each at an
   address of its own, times one window (bins) each; and all of it times `turn` (bins). Groups without a row are left as
   they are. In `out` (bins, actuators) groups are `apart` numbers apart. `room` is for 4 numbers per actuator. */
WIDE EXPORTED void wavefocus_sum(const uintptr_t *RESTRICT rows, const double *RESTRICT windows,
                                 const int64_t *RESTRICT bounds, ptrdiff_t groups, ptrdiff_t bins, ptrdiff_t actuators,
                                 const double *RESTRICT turn, double *RESTRICT room, double *RESTRICT out,
                                 ptrdiff_t apart)
{
    const ptrdiff_t parts = 2 * actuators, window = 2 * bins;
    double *RESTRICT by_real = room, *RESTRICT by_imaginary = room + parts;
    for (ptrdiff_t begin = 0; begin < bins; begin += CHUNK)
        for (ptrdiff_t group = 0; group < groups; group++) {
            const ptrdiff_t first = (ptrdiff_t)bounds[group], last = (ptrdiff_t)bounds[group + 1];
            const ptrdiff_t end = first == last ? begin : begin + CHUNK < bins ? begin + CHUNK : bins;
            for (ptrdiff_t bin = begin; bin < end; bin++) {
                memset(room, 0, 2 * (size_t)parts * sizeof *room);
                for (ptrdiff_t row = first; row < last; row++) {
                    const double *RESTRICT in = (const double *)rows[row] + bin * parts;
                    const double re = windows[row * window + 2 * bin], im = windows[row * window + 2 * bin + 1];
                    INDEPENDENT for (ptrdiff_t i = 0; i < parts; i++) {
                        by_real[i] += re * in[i];
                        by_imaginary[i] += im * in[i];
                    }
                }
                const double turn_re = turn[2 * bin], turn_im = turn[2 * bin + 1];
                double *RESTRICT to = out + group * apart + bin * parts;
                INDEPENDENT for (ptrdiff_t i = 0; i < parts; i += 2) {
                    const double re = by_real[i] - by_imaginary[i + 1], im = by_real[i + 1] + by_imaginary[i];
                    to[i] = re * turn_re - im * turn_im;
                    to[i + 1] = re * turn_im + im * turn_re;
                }
            }
        }
}

/* --- drives ------------------------------------------------------------------------------------------------------ */

/* Signals times a factor, in double precision, and the energies of what they become. In `in` and in `out` they are so
   many numbers apart. For either type of `in`. */
#define SCALE(in, in_apart, signals, samples, factor, out, out_apart, energies)                                        \
    for (ptrdiff_t signal = 0; signal < (signals); signal++, (in) += (in_apart), (out) += (out_apart)) {               \
        double sums[LANES] = {0.0}, sum = 0.0;                                                                         \
        ptrdiff_t i = 0;                                                                                               \
        for (; i + LANES <= (samples); i += LANES)                                                                     \
            for (int lane = 0; lane < LANES; lane++) {                                                                 \
                const double value = (double)(in)[i + lane] * (factor);                                                \
                (out)[i + lane] = value;                                                                               \
                sums[lane] += value * value;                                                                           \
            }                                                                                                          \
        for (; i < (samples); i++) {                                                                                   \
            const double value = (double)(in)[i] * (factor);                                                           \
            (out)[i] = value;                                                                                          \
            sum += value * value;                                                                                      \
        }                                                                                                              \
        for (int lane = 0; lane < LANES; lane++)                                                                       \
            sum += sums[lane];                                                                                         \
        (energies)[signal] = sum;                                                                                      \
    }

WIDE EXPORTED void wavefocus_widen(const float *RESTRICT in, ptrdiff_t in_apart, ptrdiff_t signals, ptrdiff_t samples,
                                   double factor, double *RESTRICT out, ptrdiff_t out_apart, double *RESTRICT energies)
{
    SCALE(in, in_apart, signals, samples, factor, out, out_apart, energies)
}

WIDE EXPORTED void wavefocus_scale(const double *RESTRICT in, ptrdiff_t in_apart, ptrdiff_t signals, ptrdiff_t samples,
                                   double factor, double *RESTRICT out, ptrdiff_t out_apart, double *RESTRICT energies)
{
    SCALE(in, in_apart, signals, samples, factor, out, out_apart, energies)
}
