"""The C99 text around a policy's numbers."""

HEADER = """\
/* Follower {name}, exported by mjxball {version}: {origin}.
 *
 *   mjxball_follower follower;
 *   mjxball_reset(&follower);                                   before every flight
 *   mjxball_follow(&follower, observation, action, command);    every {period} s
 *
 * observation (18), SI units and radians, world axes, body rates in body axes:
{observation}
 * action (3): the network's mean in [-1, 1]. command (3): roll [rad], pitch [rad], vertical acceleration [m/s2].
 *
 * Network {layers}, ReLU, tanh. C99, needs math.h; no allocation, no globals but constants.
 * Flash: {flash} bytes of constants, and the code. RAM: {state} bytes for mjxball_follower,
 * {stack} bytes of arrays on the stack during mjxball_follow.
 * Define MJXBALL_REAL as double before including this for arithmetic without rounding to float, at twice the RAM.
 */
#ifndef MJXBALL_FOLLOWER_H
#define MJXBALL_FOLLOWER_H

#include <math.h>

#ifndef MJXBALL_REAL
#define MJXBALL_REAL float
#endif
typedef MJXBALL_REAL mjxball_real;

#define MJXBALL_OBSERVATION_SIZE 18
#define MJXBALL_ACTION_SIZE 3
#define MJXBALL_MEMORY_SIZE {memory_size}
#define MJXBALL_CONTROL_PERIOD {period}

typedef struct {{
{memory_field}    int running;
}} mjxball_follower;

{arrays}

static inline void mjxball_copy(mjxball_real *to, const mjxball_real *from, int count) {{
    for (int i = 0; i < count; i++) to[i] = from[i];
}}
{helpers}
static inline mjxball_real mjxball_clip(mjxball_real value, mjxball_real limit) {{
    return value < -limit ? -limit : value > limit ? limit : value;
}}

/* to = weight from + bias. Four sums side by side keep a pipelined FPU busy and round less than one long sum. */
static inline void mjxball_layer(
    const float *weight, const float *bias, int inputs, int outputs, const mjxball_real *from, mjxball_real *to) {{
    for (int row = 0; row < outputs; row++, weight += inputs) {{
        mjxball_real sum[4] = {{0, 0, 0, 0}};
        int k = 0;
        for (; k + 4 <= inputs; k += 4)
            for (int lane = 0; lane < 4; lane++) sum[lane] += weight[k + lane] * from[k + lane];
        for (; k < inputs; k++) sum[0] += weight[k] * from[k];
        to[row] = (sum[0] + sum[1]) + (sum[2] + sum[3]) + bias[row];
    }}
}}

/* Forget the past: the next call starts a flight. */
static inline void mjxball_reset(mjxball_follower *follower) {{
    follower->running = 0;
}}

static inline void mjxball_follow(
    mjxball_follower *follower, const mjxball_real observation[18], mjxball_real action[3], mjxball_real command[3]) {{
    mjxball_real input[{size}], hidden[2][{widest}];
{memory_pointer}    int i;
    mjxball_copy(input, observation, 18);
{history}
    for (i = 0; i < {size}; i++) input[i] = (input[i] - mjxball_mean[i]) * mjxball_scale[i];
{network}
    for (i = 0; i < 3; i++) action[i] = (mjxball_real)tanh((double)action[i]);
{command}
    for (i = 0; i < 3; i++)
        command[i] = mjxball_clip(command[i] + mjxball_action_scale[i] * action[i], mjxball_limit[i]);
{history_update}
}}

#endif
"""
APPROACH = """
static inline void mjxball_approach(mjxball_real *average, const mjxball_real *value, int count, float share) {
    for (int i = 0; i < count; i++) average[i] += share * (value[i] - average[i]);
}
"""
