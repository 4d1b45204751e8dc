/* Controllers of pair drone: its estimate of the pair, the leader's PID, the follower's network. Part of core.c. */
#ifndef MJXBALL_CONTROLLERS_H
#define MJXBALL_CONTROLLERS_H

#include "core.h"

#include "rig.h"

#define MOST_INTEGRAL 1000.0f    /* [m s] of the leader's error */

/* Arithmetic. */

/* Values that are not finite are returned unchanged. */
static float clip(float value, float low, float high) {
    if (!mjxball_are_finite(&value, 1)) return value;
    return value < low ? low : value > high ? high : value;
}

/* Whether all magnitudes are at most `limit`, by their bits, which are ordered like the values; false for NaN. */
static bool within(const float *values, int count, float limit) {
    return mjxball_most(values, count) <= mjxball_most(&limit, 1);
}

static float root(float x) {
    return x > 0 ? __builtin_sqrtf(x) : 0;
}

/* Taylor series up to tan(pi / 8), where it is exact to float; larger arguments are reduced. */
static float arctan(float x) {
    float size = x < 0 ? -x : x, base = 0, square, value = 0;
    if (size > 2.4142135f) {
        base = 1.5707963f;
        size = -1 / size;
    } else if (size > 0.41421356f) {
        base = 0.78539816f;
        size = (size - 1) / (size + 1);
    }
    square = size * size;
    for (int k = 17; k > 0; k -= 2) value = 1 / (float)k - square * value;
    value = base + size * value;
    return x < 0 ? -value : value;
}

static float arctan2(float y, float x) {
    if (x > 0) return arctan(y / x);
    if (x < 0) return arctan(y / x) + (y < 0 ? -3.1415927f : 3.1415927f);
    return y > 0 ? 1.5707963f : y < 0 ? -1.5707963f : 0;
}

static float cosine(float x) {
    float square = x * x, value = 1;
    for (int k = 12; k > 0; k -= 2) value = 1 - square * value / (float)(k * (k - 1));
    return value;
}

static void rotation(const float *q, float matrix[3][3]) {
    float w = q[0], x = q[1], y = q[2], z = q[3];
    matrix[0][0] = 1 - 2 * (y * y + z * z);
    matrix[0][1] = 2 * (x * y - w * z);
    matrix[0][2] = 2 * (x * z + w * y);
    matrix[1][0] = 2 * (x * y + w * z);
    matrix[1][1] = 1 - 2 * (x * x + z * z);
    matrix[1][2] = 2 * (y * z - w * x);
    matrix[2][0] = 2 * (x * z - w * y);
    matrix[2][1] = 2 * (y * z + w * x);
    matrix[2][2] = 1 - 2 * (x * x + y * y);
}

static void cross(const float *a, const float *b, float *to) {
    to[0] = a[1] * b[2] - a[2] * b[1];
    to[1] = a[2] * b[0] - a[0] * b[2];
    to[2] = a[0] * b[1] - a[1] * b[0];
}

/* The pair's state by this drone's estimate. */

typedef struct {
    float position[3], velocity[3], euler[3], rates[3], matrix[3][3]; /* of O */
    float level; /* cosine of the drone's tilt */
} pair_state;

static void rotate(const pair_state *by, const float *vector, float *to) {
    for (int i = 0; i < 3; i++)
        to[i] = by->matrix[i][0] * vector[0] + by->matrix[i][1] * vector[1] + by->matrix[i][2] * vector[2];
}

/* p_O = p - R r, with r `mount`. On a stand the locked coordinates are 0. */
static void estimate_pair(const float *mount, const mjxball_state *state, pair_state *to) {
    float arm[3], swing[3], sweep[3];
    rotation(state->quaternion, to->matrix);
    rotate(to, mount, arm);
    cross(state->rates, mount, swing);
    rotate(to, swing, sweep);
    to->level = to->matrix[2][2];
    for (int i = 0; i < 3; i++) {
        to->position[i] = state->position[i] - arm[i];
        to->velocity[i] = state->velocity[i] - sweep[i];
        to->rates[i] = state->rates[i];
    }
    to->euler[0] = arctan2(to->matrix[2][1], root(1 - to->matrix[2][1] * to->matrix[2][1]));
    to->euler[1] = arctan2(-to->matrix[2][0], to->matrix[2][2]);
    to->euler[2] = arctan2(-to->matrix[0][1], to->matrix[1][1]);
    if (mjxball_rig.stand) {
        float c = root(1 - to->matrix[2][1] * to->matrix[2][1]), s = to->matrix[2][1];
        const float roll[3][3] = {{1, 0, 0}, {0, c, -s}, {0, s, c}};
        for (int i = 0; i < 9; i++) to->matrix[i / 3][i % 3] = roll[i / 3][i % 3];
        for (int i = 0; i < 2; i++) to->position[i] = to->velocity[i] = to->euler[i + 1] = to->rates[i + 1] = 0;
    }
}

/* Position and velocity of a mount relative to O, 0 in the locked coordinates of a stand. */
static void arm_of(const pair_state *pair, const float *mount, float *arm, float *sweep) {
    float swing[3];
    rotate(pair, mount, arm);
    cross(pair->rates, mount, swing);
    rotate(pair, swing, sweep);
    if (mjxball_rig.stand) arm[0] = arm[1] = sweep[0] = sweep[1] = 0;
}

#if MJXBALL_FOLLOWER
static void observe(const pair_state *pair, const float *goal, float goal_rate, float *to) {
    float arm[3], sweep[3];
    arm_of(pair, mjxball_rig.mount[1], arm, sweep);
    for (int i = 0; i < 3; i++) {
        to[i] = pair->position[i] + arm[i];
        to[3 + i] = pair->euler[i];
        to[6 + i] = pair->velocity[i] + sweep[i];
        to[9 + i] = pair->rates[i];
        to[12 + i] = goal[i] - pair->position[i];
        to[15 + i] = -pair->velocity[i];
    }
    to[17] += goal_rate;
}

#ifdef MJXBALL_MOUNT_ANGLE
/* Rotates `count` / 3 vectors about z by the angle with cosine `c` and sine `s`. */
static void turn(float *vectors, int count, float c, float s) {
    for (int k = 0; k + 1 < count; k += 3) {
        float x = vectors[k], y = vectors[k + 1];
        vectors[k] = c * x - s * y;
        vectors[k + 1] = s * x + c * y;
    }
}
#endif
#endif

/* Controllers, as in sim/controllers.py. */

static void clip_command(float *command) {
    for (int i = 0; i < 3; i++) command[i] = clip(command[i], -mjxball_limit[i], mjxball_limit[i]);
}

static void command_of(const float *acceleration, float *command) {
    command[0] = -acceleration[1] / (float)MJXBALL_GRAVITY;
    command[1] = acceleration[0] / (float)MJXBALL_GRAVITY;
    command[2] = acceleration[2];
    clip_command(command);
}

#if !MJXBALL_FOLLOWER
static void leader_error(const pair_state *pair, const float *goal, float goal_rate, float *error, float *rate) {
    float arm[3], sweep[3];
    arm_of(pair, mjxball_rig.mount[0], arm, sweep);
    for (int i = 0; i < 3; i++) {
        error[i] = goal[i] - pair->position[i];
        rate[i] = -pair->velocity[i];
        if (mjxball_rig.own_error) {
            error[i] += mjxball_rig.stand && i < 2 ? 0 : mjxball_rig.mount[0][i] - arm[i];
            rate[i] -= sweep[i];
        }
    }
    rate[2] += goal_rate;
}

static void pid(const float *error, const float *rate, const float *integral, float *command) {
    float acceleration[3];
    for (int i = 0; i < 3; i++)
        acceleration[i] = mjxball_rig.kp[i] * error[i] + mjxball_rig.kd[i] * rate[i] + mjxball_rig.ki[i] * integral[i];
    command_of(acceleration, command);
}
#endif

/* One period of this drone's controller: sets `app->command`. False if the network's output is not finite.
   `goal_rate`: of the goal's height [m/s]. */
static bool compute_command(mjxball_app *app, const pair_state *pair, const float *goal, float goal_rate) {
    float *command = app->command;
    bool good = true;
#if MJXBALL_FOLLOWER
    float observation[18];
    observe(pair, goal, goal_rate, observation);
#ifdef MJXBALL_MOUNT_ANGLE
    turn(observation, 18, mjxball_rig.mount_frame[0], -mjxball_rig.mount_frame[1]);
#endif
    if (!app->copying) good = !mjxball_follow(&app->follower, observation, app->action, command);
    if (app->copying || !good) mjxball_copy_command(observation, command);
#ifdef MJXBALL_MOUNT_ANGLE
    turn(command, 3, mjxball_rig.mount_frame[0], mjxball_rig.mount_frame[1]);
#endif
#else
    const float period = (float)mjxball_rig.period / 1000;
    float error[3], rate[3];
    leader_error(pair, goal, goal_rate, error, rate);
    pid(error, rate, app->integral, command);
    for (int i = 0; i < 3; i++) {
        float ahead = error[i] + mjxball_rig.lead * rate[i];
        ahead = clip(ahead, -mjxball_rig.band[i], mjxball_rig.band[i]);
        app->integral[i] = clip(app->integral[i] + period * ahead, -MOST_INTEGRAL, MOST_INTEGRAL);
    }
#endif
    return good;
}

#endif
