"""Templates of the C code of an exported follower, which `c_header` fills in."""

HEADER = """\
/* Follower {name}, trained by mjxball {trained} ({origin}), exported by mjxball {version}.
 *
 *   mjxball_follower follower = {{0}};
 *   mjxball_reset(&follower);                                              before every flight
 *   int status = mjxball_follow(&follower, observation, action, command);  every {period} s
 *
 * observation (18), SI units and radians, world axes, body rates in body axes:
{observation}
 * action (3): the network's mean in [-1, 1]. command (3): roll [rad], pitch [rad], vertical acceleration [m/s2].
 * status: 0, or else action and command are zeros, which is level flight. 1: the observation is not finite, or its
 * absolute sum is not below MJXBALL_LARGEST; the memory is unchanged. 2: an intermediate result is not finite; the next
 * call starts a flight. The checks hold with -ffast-math too, because they look at bits.
{team} *
 * Network {layers}, ReLU, tanh{weights}. C99 without a library; no allocation, no globals but constants.
 * Results are bit-equal on all machines with IEEE floats if products and sums are not contracted (-ffp-contract=off).
 * Flash: {flash} bytes of constants, and the code. RAM: {state} bytes for mjxball_follower,
 * {stack} bytes of arrays on the stack during mjxball_follow.
 * Define MJXBALL_REAL as double before including this for arithmetic without rounding to float, at twice the RAM.
 * Headers of several policies can be used together: names come from the file's name.
 */
#ifndef MJXBALL_GUARD
#define MJXBALL_GUARD

{includes}#ifndef MJXBALL_REAL
#define MJXBALL_REAL float
#endif
typedef MJXBALL_REAL mjxball_real;

#define MJXBALL_OBSERVATION_SIZE 18
#define MJXBALL_ACTION_SIZE 3
#define MJXBALL_MEMORY_SIZE {memory_size}
#define MJXBALL_MOST_INPUTS {most_inputs}
#define MJXBALL_LARGEST {largest}
{int8}#define MJXBALL_CONTROL_PERIOD {period}
#define MJXBALL_GRAVITY {gravity}
{mount_angle}
{weights_type}typedef struct {{
{memory_field}{weights_field}    int running;
}} mjxball_follower;

{arrays}
{compiled}
static inline void mjxball_copy(mjxball_real *to, const mjxball_real *from, int count) {{
    for (int i = 0; i < count; i++) to[i] = from[i];
}}
/* The bits of the largest absolute value as float. Bits have the order of the values; from 0x7F800000 on, these are not
 * finite. The result is volatile, so that -ffinite-math-only cannot remove checks of it. */
static inline unsigned mjxball_most(const mjxball_real *values, int count) {{
    volatile unsigned most;
    unsigned found = 0;
    for (int i = 0; i < count; i++) {{
        union {{
            float value;
            unsigned bits;
        }} one;
        one.value = (float)values[i];
        one.bits &= 0x7FFFFFFFu;
        if (one.bits > found) found = one.bits;
    }}
    most = found;
    return most;
}}
static inline int mjxball_are_finite(const mjxball_real *values, int count) {{
    return mjxball_most(values, count) < 0x7F800000u;
}}
/* Whether all values are finite and their absolute sum is below `MJXBALL_LARGEST`. */
static inline int mjxball_is_sound(const mjxball_real *values, int count) {{
    mjxball_real sum = 0;
    if (!mjxball_are_finite(values, count)) return 0;
    for (int i = 0; i < count; i++) sum += values[i] < 0 ? -values[i] : values[i];
    return sum < MJXBALL_LARGEST;
}}
/* A value that is not finite is returned unchanged. */
static inline mjxball_real mjxball_clip(mjxball_real value, mjxball_real limit) {{
    if (!mjxball_are_finite(&value, 1)) return value;
    return value < -limit ? -limit : value > limit ? limit : value;
}}
{helpers}
/* The leader's PD controller on the observed error: the command of the `copy` follower. */
static inline void mjxball_copy_command(const mjxball_real *observation, mjxball_real *to) {{
{leader}
}}
/* Clear the memory: the next call starts a flight. */
static inline void mjxball_reset(mjxball_follower *follower) {{
    follower->running = 0;
}}
static inline int mjxball_no_answer(mjxball_follower *follower, mjxball_real action[3], mjxball_real command[3]) {{
    for (int i = 0; i < 3; i++) action[i] = command[i] = 0;
    mjxball_reset(follower);
    return 2;
}}

static inline int mjxball_follow(
    mjxball_follower *follower, const mjxball_real observation[18], mjxball_real action[3], mjxball_real command[3]) {{
    mjxball_real input[{size}], hidden[2][{widest}];
{memory_pointer}    int i;
    for (i = 0; i < 3; i++) action[i] = command[i] = 0;
    if (!mjxball_is_sound(observation, 18)) return 1;
    mjxball_copy(input, observation, 18);
{history}
{network}
    if (!mjxball_are_finite(action, 3)) return mjxball_no_answer(follower, action, command);
    for (i = 0; i < 3; i++) action[i] = mjxball_tanh(action[i]);
{command}
    if (!mjxball_are_finite(command, 3)) return mjxball_no_answer(follower, action, command);
{history_update}
    return 0;
}}

#endif
"""
APPROACH = """
static inline void mjxball_approach(mjxball_real *average, const mjxball_real *value, int count, float share) {
    for (int i = 0; i < count; i++) average[i] += share * (value[i] - average[i]);
}
"""
ARE_SAME = """
static inline int mjxball_are_same(const mjxball_real *one, const mjxball_real *other, int count) {
    for (int i = 0; i < count; i++)
        if (one[i] != other[i]) return 0;
    return 1;
}
"""
LAYER = """
/* Keep products and sums as separate instructions where a fused one takes longer (Cortex-M4). */
#ifdef __ARM_FEATURE_DSP
#define MJXBALL_APART(a, b, c, d) __asm__("" : "+w"(a), "+w"(b), "+w"(c), "+w"(d))
#else
#define MJXBALL_APART(a, b, c, d) (void)0
#endif
/* Four rows at once, whose weights are interleaved, so that each input is loaded once for all four. */
#define MJXBALL_ADD(weight, from, a, b, c, d) \\
    do { \\
        mjxball_real p = (weight)[0] * (from), q = (weight)[1] * (from); \\
        mjxball_real r = (weight)[2] * (from), s = (weight)[3] * (from); \\
        MJXBALL_APART(p, q, r, s); \\
        a += p; \\
        b += q; \\
        c += r; \\
        d += s; \\
    } while (0)

/* to = weight from + bias; a null bias is zero. Rows are padded to a multiple of four. Separate sums over even and odd
 * inputs round less than one long sum. If `from` is not finite, nothing is written and 0 returned. */
static inline int mjxball_layer(
    const float *weight, const float *bias, int inputs, int outputs, const mjxball_real *from, mjxball_real *to) {
    if (!mjxball_are_finite(from, inputs)) return 0;
    for (int row = 0; row < outputs; row += 4, weight += 4 * (inputs & 1)) {
        mjxball_real a = 0, b = 0, c = 0, d = 0, e = 0, f = 0, g = 0, h = 0;
        int k = 0;
        for (; k < (inputs & ~1); k += 2, weight += 8) {
            MJXBALL_ADD(weight, from[k], a, b, c, d);
            MJXBALL_ADD(weight + 4, from[k + 1], e, f, g, h);
        }
        if (inputs & 1) MJXBALL_ADD(weight, from[k], a, b, c, d);
        const mjxball_real sums[4] = {a + e, b + f, c + g, d + h};
        for (int i = 0; i < 4 && row + i < outputs; i++) to[row + i] = sums[i] + (bias ? bias[row + i] : 0);
    }
    return 1;
}
"""
LAYER_INT8 = """
/* The nearest integer of a value within 16 bits. */
static inline int16_t mjxball_whole(mjxball_real value) {
    return (int16_t)((int)(value + (mjxball_real)32768.5) - 32768);
}

/* Quantise values to 16 bits and return the step: the largest value takes the whole range; zeros follow up to `stride`.
 * The middle two of every four values are swapped, as `mjxball_products` needs. If a value is not finite, nothing is
 * written and 0 returned. */
static inline mjxball_real mjxball_steps(const mjxball_real *from, int count, int stride, int16_t *to) {
    const union {
        unsigned bits;
        float value;
    } most = {mjxball_most(from, count)};
    const mjxball_real largest = most.value > 1e-30f ? most.value : 1e-30f, per_step = 32767 / largest;
    int k;
    if (most.bits >= 0x7F800000u) return 0;
    for (k = stride - 8; k < stride; k++) to[k] = 0;
    for (k = 0; k < (count & ~3); k += 4) {
        to[k] = mjxball_whole(from[k] * per_step);
        to[k + 2] = mjxball_whole(from[k + 1] * per_step);
        to[k + 1] = mjxball_whole(from[k + 2] * per_step);
        to[k + 3] = mjxball_whole(from[k + 3] * per_step);
    }
    for (; k < count; k++) to[((k + 1) & 2) ? k ^ 3 : k] = mjxball_whole(from[k] * per_step);
    return largest / 32767;
}

/* `sum` plus four products of a row, with two multiplications per instruction where the processor has them. */
#ifdef __ARM_FEATURE_DSP
#include <arm_acle.h>
static inline int32_t mjxball_products(const int8_t *weight, const int16_t *steps, int32_t sum) {
    uint32_t four;
    int16x2_t outer, inner, odd;
    __builtin_memcpy(&four, weight, 4);
    __builtin_memcpy(&outer, steps, 4);
    __builtin_memcpy(&inner, steps + 2, 4);
    __asm__("sxtb16 %0, %1, ror #8" : "=r"(odd) : "r"(four));
    return __smlad(odd, inner, __smlad(__sxtb16((int8x4_t)four), outer, sum));
}
/* Barrier: later loads must not move up, because registers are few. */
#define MJXBALL_HERE __asm__ volatile("" ::: "memory")
#else
#define MJXBALL_HERE (void)0
static inline int32_t mjxball_products(const int8_t *weight, const int16_t *steps, int32_t sum) {
    sum += weight[0] * steps[0] + weight[2] * steps[1];
    return sum + weight[1] * steps[2] + weight[3] * steps[3];
}
#endif

/* to = step weight from + bias with integer weights; a null bias is zero. Rows have `stride` weights, of which `inputs`
 * are used, and are padded to a multiple of four. Four rows at once share the loads of `from`. If `from` is not finite,
 * nothing is written and 0 returned. */
static inline int mjxball_layer(const int8_t *weight, const float *step, const float *bias, int inputs, int outputs,
    int stride, const mjxball_real *from, mjxball_real *to) {
    int16_t steps[MJXBALL_MOST_INPUTS + 7];
    const mjxball_real size = mjxball_steps(from, inputs, stride, steps);
    if (size <= 0) return 0;
    for (int row = 0; row < outputs; row += 4, weight += 4 * stride) {
        int32_t a = 0, b = 0, c = 0, d = 0;
        for (int k = 0; k < stride; k += 8) {
            a = mjxball_products(weight + k, steps + k, a);
            b = mjxball_products(weight + stride + k, steps + k, b);
            c = mjxball_products(weight + 2 * stride + k, steps + k, c);
            d = mjxball_products(weight + 3 * stride + k, steps + k, d);
            MJXBALL_HERE;
            a = mjxball_products(weight + k + 4, steps + k + 4, a);
            b = mjxball_products(weight + stride + k + 4, steps + k + 4, b);
            c = mjxball_products(weight + 2 * stride + k + 4, steps + k + 4, c);
            d = mjxball_products(weight + 3 * stride + k + 4, steps + k + 4, d);
        }
        const int32_t sums[4] = {a, b, c, d};
        for (int i = 0; i < 4 && row + i < outputs; i++)
            to[row + i] = (mjxball_real)sums[i] * (size * step[row + i]) + (bias ? bias[row + i] : 0);
    }
    return 1;
}
"""
EXPONENTIAL = """
/* exp(-x) for 0 <= x < 40, within 1e-15, as share (even - odd) / (even + odd): share is the nearest power of 1/2, the
 * fraction a Pade approximant of the rest. */
typedef struct {
    mjxball_real share, even, odd;
} mjxball_fraction;

static inline mjxball_fraction mjxball_fraction_of(mjxball_real x) {
    const int halvings = (int)(x * (mjxball_real)1.4426950408889634 + (mjxball_real)0.5);
    const mjxball_real rest = x - (mjxball_real)halvings * (mjxball_real)0.69314718055994531, square = rest * rest;
    const union {
        unsigned bits;
        float value;
    } share = {(127u - (unsigned)halvings) << 23};
    const mjxball_fraction one = {share.value, 30240 + square * (3360 + 30 * square),
        rest * (15120 + square * (420 + square))};
    return one;
}

static inline mjxball_real mjxball_tanh(mjxball_real x) {
    const mjxball_real size = x < 0 ? -x : x;
    if (size > 20) return x < 0 ? -1 : 1;
    const mjxball_fraction one = mjxball_fraction_of(2 * size);
    const mjxball_real less = 1 - one.share, more = 1 + one.share;
    const mjxball_real value = (less * one.even + more * one.odd) / (more * one.even + less * one.odd);
    return x < 0 ? -value : value;
}
"""
GRU = """
/* The next state of a gated recurrent unit. `given` and `kept`: contributions of inputs and of the state to the reset
 * gates, update gates and candidates. */
static inline void mjxball_gru(
    const mjxball_real *given, const mjxball_real *kept, const mjxball_real *state, int units, mjxball_real *next) {
    const mjxball_real half = (mjxball_real)0.5;
    for (int k = 0; k < units; k++) {
        mjxball_real reset = half + half * mjxball_tanh(half * (given[k] + kept[k]));
        mjxball_real update = half + half * mjxball_tanh(half * (given[units + k] + kept[units + k]));
        mjxball_real candidate = mjxball_tanh(given[2 * units + k] + reset * kept[2 * units + k]);
        next[k] = candidate + update * (state[k] - candidate);
    }
}
"""
