/* Checks of all inputs and outputs in every period. Part of core.c. */
#ifndef MJXBALL_CHECKS_H
#define MJXBALL_CHECKS_H

#include "core.h"

#include "controllers.h"
#include "rig.h"

#define CEILING 60000.0f        /* [thrust units] */
#define FLOOR 10001.0f
#define SENT_TILT 0.2617994f    /* [rad] 15 degrees, largest roll and pitch of a setpoint */
#define DEGREES 57.295780f      /* per radian */
#define STATE_AGE 100u          /* [ms] */
#define VARIANCE 5e-4f          /* [m2] */
#define MOST_PLACE 1000.0f      /* [m] coordinate of a state */
#define MOST_SPEED 50.0f        /* [m/s] of a state and of a heartbeat */
#define MOST_RATE 50.0f         /* [rad/s]; the gyroscope's range is 35 */
#define MOST_VOLTAGE 10.0f      /* [V] */

/* Parameters. */

static bool in_fence(const float *place) {
    for (int i = 0; i < 3; i++)
        if (place[i] < mjxball_rig.fence_low[i] || place[i] > mjxball_rig.fence_high[i]) return false;
    return within(place, 3, 2 * MOST_PLACE);
}

static bool goal_is_good(const mjxball_parameters *set) {
    for (int drone = 0; drone < 2; drone++) {
        float place[3];
        for (int i = 0; i < 3; i++) place[i] = set->goal[i] + mjxball_rig.mount[drone][i];
        if (!in_fence(place)) return false;
    }
    return true;
}

static bool mount_is_set(const mjxball_parameters *set) {
    float size = 0;
    for (int i = 0; i < 3; i++) size += set->mount[i] * set->mount[i];
    return within(set->mount, 3, 1) && size > 1e-6f && size < 1;
}

/* The first fault of the parameters, MJXBALL_GOOD for none. */
static uint8_t fault_of(const mjxball_parameters *set) {
    if (!mount_is_set(set)) return MJXBALL_NO_MOUNT;
    if (!goal_is_good(set)) return MJXBALL_BAD_GOAL;
    if (set->curve > 1 || !mjxball_rig.maps[set->curve].known) return MJXBALL_BAD_CURVE;
    return within(&set->battery, 1, MOST_VOLTAGE) && set->battery > 0 ? MJXBALL_GOOD : MJXBALL_BAD_BATTERY;
}

/* Takes over parameters, which can change at any time, if all are valid. The mount is fixed once the motors turn, the
 * curve once the ramp begins, since the laptop finds the curve by spinning motors. Returns the fault. */
static uint8_t adopt(mjxball_app *app, const mjxball_parameters *asked) {
    const bool running = app->phase != MJXBALL_IDLE;
    uint8_t fault = fault_of(asked);
    for (int i = 0; i < 3; i++)
        if (!fault && running && asked->mount[i] != app->set.mount[i]) fault = MJXBALL_NOT_ON_GROUND;
    if (!fault && app->phase > MJXBALL_SPIN && asked->curve != app->set.curve) fault = MJXBALL_NOT_ON_GROUND;
    if (!fault) app->set = *asked;
    if (fault && running) app->refusal = fault;
    return fault;
}

/* The state. */

static bool state_is_good(const mjxball_state *state, uint32_t now) {
    const float *q = state->quaternion;
    float size = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    return within(state->position, 3, MOST_PLACE) && within(state->velocity, 3, MOST_SPEED)
        && within(state->rates, 3, MOST_RATE) && within(q, 4, 2) && size > 0.9f && size < 1.1f
        && now - state->time <= STATE_AGE;
}

/* An estimator that does not run has a variance of 0. */
static bool estimate_is_good(const mjxball_state *state) {
    for (int i = mjxball_rig.stand ? 2 : 0; i < 3; i++)
        if (!within(state->variance + i, 1, VARIANCE) || state->variance[i] <= 0) return false;
    return true;
}

static bool is_charged(const mjxball_app *app, const mjxball_state *state) {
    return within(&state->voltage, 1, MOST_VOLTAGE) && state->voltage >= app->set.battery;
}

/* Command of the controller, and setpoint. */

static bool command_is_good(const mjxball_app *app) {
    return within(app->command, 3, 1000);
}

static bool setpoint_is_good(const mjxball_setpoint *out) {
    return within(&out->roll, 1, DEGREES * SENT_TILT) && within(&out->pitch, 1, DEGREES * SENT_TILT)
        && within(&out->thrust, 1, CEILING) && out->thrust >= FLOOR;
}

#endif
