/* See core.h. No allocation, no global variables, no library; compile with -ffp-contract=off. */
#include "core.h"

#include "checks.h"
#include "controllers.h"
#include "packets.h"
#include "rig.h"

#define SPIN_THRUST 16000.0f
#define MOST_TILT 0.76604444f /* cosine of 40 degrees */
#define LAPTOP_AGE 500u       /* [ms] */
#define PEER_AGE 300u
#define RAMP_TIME 1500u
#define LAND_SPEED 0.25f      /* [m/s] */
#define EASE 0.8f             /* [s] in which a landing's goal leaves its former height */
#define SINK_SPEED 0.4f
#define BLIND_SPEED 0.5f
#define DESCEND_TIME 4000u    /* [ms] */
#define STOP_TIME 3000u       /* the firmware counts as flying for 2 s */
#define SETTLED 300u
#define SATURATED_TIME 1000u
#define BATTERY_TIME 5000u
#define STILL 0.12f           /* [m/s] */
#define REST 150u             /* [ms] it has landed if it does not sink by more than RESTING for this time */
#define RESTING 0.005f        /* [m] */
#define LIFT_TIME 4000u       /* [ms] after the ramp */
#define SIDE (MJXBALL_FOLLOWER ? 1.0f : -1.0f) /* sign of `apart` in this drone's lift */

const char *mjxball_text(int cause) {
    return cause >= 0 && cause < MJXBALL_CAUSES ? mjxball_texts[cause] : "unknown";
}

int mjxball_period(void) {
    return mjxball_rig.period;
}

uint32_t mjxball_ident(const mjxball_app *app) {
#if MJXBALL_UPLOADS
    if (app->follower.weights) return app->upload.crc;
#endif
    (void)app;
    return mjxball_rig.ident;
}

/* Thrust. */

static float thrust_of_force(const mjxball_map *map, float force) {
    float a = map->quadratic, b = map->linear, each = force > 0 ? force / 4 : 0;
    return 65535 * (a > 0 ? (root(b * b + 4 * a * each) - b) / (2 * a) : each / b);
}

static float hover_of(const mjxball_app *app, const mjxball_map *map) {
    float weight = app->needed * mjxball_rig.carried[MJXBALL_FOLLOWER] * (float)MJXBALL_GRAVITY;
    return mjxball_rig.paper ? app->needed * map->hover : thrust_of_force(map, weight);
}

static void send_level(mjxball_setpoint *out, float roll, float pitch, float thrust) {
    out->active = true;
    out->roll = DEGREES * clip(roll, -SENT_TILT, SENT_TILT);
    out->pitch = -DEGREES * clip(pitch, -SENT_TILT, SENT_TILT);
    out->thrust = clip(thrust, FLOOR, CEILING);
}

/* True if the thrust was clipped. */
static bool send_command(const mjxball_app *app, const mjxball_map *map, mjxball_setpoint *out) {
    float roll = clip(app->command[0], -SENT_TILT, SENT_TILT), pitch = clip(app->command[1], -SENT_TILT, SENT_TILT);
    float up = app->command[2], thrust = app->needed * (map->hover + map->per_acceleration * up);
    if (!mjxball_rig.paper) {
        float force = app->needed * mjxball_rig.carried[MJXBALL_FOLLOWER] * ((float)MJXBALL_GRAVITY + up);
        thrust = thrust_of_force(map, force / (cosine(roll) * cosine(pitch)));
    }
    send_level(out, roll, pitch, thrust);
    return thrust < FLOOR || thrust > CEILING;
}

/* The supervisor. */

static bool peer_is_heard(const mjxball_app *app) {
    return app->peer_time && app->now - app->peer_time <= PEER_AGE;
}

static bool laptop_is_heard(const mjxball_app *app) {
    return app->laptop_time && app->now - app->laptop_time <= LAPTOP_AGE;
}

/* Why it must not start, MJXBALL_GOOD if it may. */
static uint8_t refusal_of(const mjxball_app *app, uint8_t fault, const mjxball_state *state) {
    if (fault) return fault;
    if (!state_is_good(state, app->now)) return MJXBALL_BAD_STATE;
    if (!estimate_is_good(state)) return MJXBALL_ESTIMATOR;
    if (!state->can_fly) return MJXBALL_CANNOT_FLY;
    if (!is_charged(app, state)) return MJXBALL_BATTERY;
    if (!peer_is_heard(app)) return MJXBALL_NO_PEER;
    if (app->peer.key != mjxball_rig.key) return MJXBALL_OTHER_POLICY;
    return app->peer.phase > MJXBALL_SPIN ? MJXBALL_PEER : MJXBALL_GOOD;
}

/* Half difference of the lifts that both take-offs found: differing attitude estimates let a single integral grow. */
static float found_apart(const mjxball_app *app) {
    float own = app->apart, other = app->peer.apart;
    if (own * other <= 0) return 0;
    if (own * own > other * other) own = other;
    return own > LOAD || own < -LOAD ? own : 0;
}

static void enter(mjxball_app *app, uint8_t phase, uint8_t cause, const mjxball_map *map) {
    const float height = app->position[2] - app->origin[2];
    const uint8_t before = app->phase;
    app->phase = phase;
    app->cause = cause;
    app->since = app->now;
    if (phase == MJXBALL_SPIN) app->needed = 1;
    if (phase == MJXBALL_FLY && !mjxball_rig.stand) app->needed = 1 + SIDE * found_apart(app);
    if (phase <= MJXBALL_FLY) app->trim = hover_of(app, map);
    if (phase == MJXBALL_SPIN) {
        for (int i = 0; i < 3; i++) app->origin[i] = app->position[i];
        app->copying = 0;
        app->trusted = 1;
        app->late = 0;
    } else if (phase == MJXBALL_FLY) {
        for (int i = 0; i < 3; i++) app->integral[i] = 0;
        app->saturated_since = app->now;
#if MJXBALL_FOLLOWER
        mjxball_reset(&app->follower);
#endif
    } else if (phase == MJXBALL_LAND) {
        app->land_height = height;
        app->goal_before = before == MJXBALL_FLY ? app->set.goal[2] : height;
    } else if (phase == MJXBALL_DESCEND) {
        app->height = height;
        app->climb = app->velocity[2];
    }
}

/* The highest requested phase, and why. */
typedef struct {
    uint8_t phase, cause;
} request;

static void ask(request *highest, uint8_t phase, uint8_t cause) {
    if (phase > highest->phase) {
        highest->phase = phase;
        highest->cause = cause;
    }
}

static float height_of(const mjxball_app *app) {
    return app->position[2] - app->origin[2];
}

/* Height from which on the legs carry no load and the controller may take over. */
static float lifted_height(const mjxball_app *app) {
    return clip(app->set.goal[2] / 2, 0.001f, LIFTED);
}

static void track_rest(mjxball_app *app, bool good) {
    float height = height_of(app);
    if (!good || !within(&app->low, 1, 2 * MOST_PLACE) || height < app->low - RESTING) {
        app->low = height;
        app->low_since = app->now;
    } else if (height > app->low) {
        app->low = height;
    }
}

static void check_flight(const mjxball_app *app, const pair_state *pair, const mjxball_state *state, bool good,
    request *to) {
    const bool guided = app->phase == MJXBALL_FLY || app->phase == MJXBALL_LAND;
    const uint32_t elapsed = app->now - app->since;
    float place[3], landing = EASE + (app->land_height + 0.3f) / LAND_SPEED + mjxball_rig.land_spare;
    for (int i = 0; i < 3; i++) place[i] = state->position[i] - app->origin[i];
    if (!laptop_is_heard(app)) ask(to, MJXBALL_LAND, MJXBALL_NO_LAPTOP);
    if (!peer_is_heard(app)) ask(to, MJXBALL_LAND, MJXBALL_NO_PEER);
    if (app->late > 10) ask(to, MJXBALL_LAND, MJXBALL_LATE);
    if (app->now - app->charged >= BATTERY_TIME) ask(to, MJXBALL_LAND, MJXBALL_BATTERY);
    if (!good) ask(to, MJXBALL_DESCEND, MJXBALL_BAD_STATE);
    if (!app->trusted) ask(to, MJXBALL_DESCEND, MJXBALL_ESTIMATOR);
    if (good && !in_fence(place)) ask(to, MJXBALL_DESCEND, MJXBALL_FENCE);
    if (guided && app->now - app->saturated_since >= SATURATED_TIME) ask(to, MJXBALL_DESCEND, MJXBALL_SATURATED);
    if (app->phase == MJXBALL_LAND && (float)elapsed > 1000 * landing) ask(to, MJXBALL_DESCEND, MJXBALL_TIMEOUT);
    if (app->phase == MJXBALL_RAMP && elapsed > RAMP_TIME + LIFT_TIME) ask(to, MJXBALL_DESCEND, MJXBALL_TIMEOUT);
    if (app->phase == MJXBALL_DESCEND && elapsed > DESCEND_TIME) ask(to, MJXBALL_STOP, MJXBALL_TIMEOUT);
    if (good && pair->level < MOST_TILT) ask(to, MJXBALL_STOP, MJXBALL_TILT);
    if (!state->can_fly) ask(to, MJXBALL_STOP, MJXBALL_CANNOT_FLY);
    if (peer_is_heard(app) && app->peer.phase == MJXBALL_IDLE) ask(to, MJXBALL_STOP, MJXBALL_PEER);
    if ((app->phase == MJXBALL_LAND || app->phase == MJXBALL_DESCEND) && elapsed >= SETTLED) {
        float height = app->position[2] - app->origin[2], climb = app->velocity[2];
        bool blind = !good || !app->trusted, rests = app->now - app->low_since >= REST;
        if (!blind && height < NEAR_GROUND && climb < STILL && climb > -STILL && rests) ask(to, MJXBALL_STOP, MJXBALL_DOWN);
        if (blind && app->phase == MJXBALL_DESCEND && app->height <= 0) ask(to, MJXBALL_STOP, MJXBALL_DOWN);
    }
}

static void supervise(mjxball_app *app, uint8_t fault, const pair_state *pair, const mjxball_state *state, bool good,
    const mjxball_map *map) {
    const uint32_t elapsed = app->now - app->since;
    const uint8_t order = laptop_is_heard(app) ? app->order : MJXBALL_IDLE;
    request to = {app->phase, app->cause};
    if (app->phase == MJXBALL_IDLE) {
        app->refusal = refusal_of(app, fault, state);
        if (order == MJXBALL_SPIN && !app->refusal) enter(app, MJXBALL_SPIN, MJXBALL_ASKED, map);
        return;
    }
    if (app->phase == MJXBALL_STOP) {
        if (elapsed >= STOP_TIME) enter(app, MJXBALL_IDLE, app->cause, map);
        return;
    }
    ask(&to, order, MJXBALL_ASKED);
    if (peer_is_heard(app)) ask(&to, app->peer.phase, MJXBALL_PEER);
    if (app->phase == MJXBALL_SPIN) {
        if (!laptop_is_heard(app)) ask(&to, MJXBALL_STOP, MJXBALL_NO_LAPTOP);
        if (!peer_is_heard(app)) ask(&to, MJXBALL_STOP, MJXBALL_NO_PEER);
        if (!good || !state->can_fly) ask(&to, MJXBALL_STOP, good ? MJXBALL_CANNOT_FLY : MJXBALL_BAD_STATE);
    } else {
        if (app->phase == MJXBALL_RAMP && elapsed >= RAMP_TIME && good && height_of(app) >= lifted_height(app))
            ask(&to, MJXBALL_FLY, MJXBALL_ASKED);
        check_flight(app, pair, state, good, &to);
    }
    /* Only a controller that has flown lands. */
    if (app->phase == MJXBALL_SPIN && to.phase > MJXBALL_FLY) to.phase = MJXBALL_STOP;
    if (app->phase == MJXBALL_RAMP && to.phase == MJXBALL_LAND) to.phase = MJXBALL_DESCEND;
    if (to.phase != app->phase) enter(app, to.phase, to.cause, map);
}

/* Roll and pitch [rad] against the horizontal `velocity`. */
static void brake(const float *velocity, float *tilt) {
    float braking[3], command[3] = {0, 0, 0};
    for (int i = 0; i < 3; i++) braking[i] = -velocity[i] / 0.7f;
    if (!mjxball_rig.stand) command_of(braking, command);
    for (int i = 0; i < 2; i++) tilt[i] = clip(command[i], -BRAKE_TILT, BRAKE_TILT);
}

/* Raises thrust until the pair is off the ground and holds the stick level, each drone by its own estimate. */
static void take_off(mjxball_app *app, const pair_state *pair, const mjxball_map *map, mjxball_setpoint *out) {
    const float period = (float)mjxball_rig.period / 1000, hover = hover_of(app, map);
    const float ramped = clip((float)(app->now - app->since) / (float)RAMP_TIME, 0, 1);
    float along[3] = {0, 0, 0}, turning[3], moving[3], tilt[2], length = 0, sine, angle, missing, off, apart;
    for (int i = 0; i < 2; i++) {
        along[i] = mjxball_rig.mount[0][i] - mjxball_rig.mount[1][i];
        length += along[i] * along[i];
    }
    for (int i = 0; i < 2; i++) along[i] /= root(length);
    rotate(pair, along, moving);
    sine = clip(moving[2], -0.99f, 0.99f);
    angle = arctan(sine / root(1 - sine * sine));
    if (ramped < BEGIN) {
        float thrust = FLOOR + ramped * (hover - FLOOR);
        app->share = thrust / hover - CLIMB_GAIN * CLIMB;
        app->apart = 0;
        app->resting = angle; /* the floor need not be level */
        send_level(out, 0, 0, thrust);
        return;
    }
    cross(pair->rates, along, turning);
    rotate(pair, turning, moving);
    brake(app->velocity, tilt);
    missing = CLIMB - app->velocity[2];
    app->share = clip(app->share + CLIMB_INTEGRAL * period * missing, 0, MOST_LIFT);
    off = angle - app->resting * (1 - clip(height_of(app) / lifted_height(app), 0, 1));
    app->apart = clip(app->apart + LEVEL_INTEGRAL * period * off, -APART, APART);
    apart = clip(app->apart + LEVEL_GAIN * off + LEVEL_DAMPING * moving[2], -APART, APART);
    send_level(out, tilt[0], tilt[1],
        hover * (clip(app->share + CLIMB_GAIN * missing, 0, MOST_LIFT) + SIDE * apart));
}

/* Brakes sideways and sinks, by the velocity estimates of both drones, or by a model of the fall without any. */
static void descend(mjxball_app *app, bool good, mjxball_setpoint *out) {
    const float period = (float)mjxball_rig.period / 1000;
    const float own = good && app->trusted, other = peer_is_heard(app) && app->peer.trusted;
    float velocity[3], tilt[2] = {0, 0}, share;
    if (own + other > 0) {
        for (int i = 0; i < 3; i++)
            velocity[i] = (own * app->velocity[i] + other * app->peer.velocity[i]) / (own + other);
        brake(velocity, tilt);
        app->climb = velocity[2];
        share = 1 + clip(-0.4f * (app->climb + SINK_SPEED), -0.3f, 0.1f);
    } else {
        float acceleration = clip(3 * (-BLIND_SPEED - app->climb), -3, -0.15f);
        app->climb += acceleration * period;
        share = 1 + acceleration / (float)MJXBALL_GRAVITY;
    }
    app->height += app->climb * period;
    send_level(out, tilt[0], tilt[1], app->trim * share);
}

/* For invalid outputs: resets computed values and sinks level, by the model of the fall. */
static void distrust(mjxball_app *app, const mjxball_map *map, mjxball_setpoint *out) {
    if (app->phase < MJXBALL_DESCEND) enter(app, MJXBALL_DESCEND, MJXBALL_BAD_COMMAND, map);
    app->trusted = 0;
    app->peer_time = 0; /* until it is heard again */
    for (int i = 0; i < 3; i++) app->integral[i] = 0;
    if (!within(app->velocity, 3, MOST_SPEED)) app->velocity[0] = app->velocity[1] = app->velocity[2] = 0;
    app->trim = hover_of(app, map);
    if (!within(&app->climb, 1, MOST_SPEED)) app->climb = 0;
    if (!within(&app->height, 1, MOST_PLACE)) app->height = mjxball_rig.fence_high[2];
    descend(app, false, out);
}

/* Height of a landing's goal above the origin [m], and its rate [m/s]: as in mjxfly/flight.py. */
static float landing_goal(const mjxball_app *app, float *rate) {
    const float elapsed = (float)(app->now - app->since) / 1000, eased = clip(elapsed, 0, EASE), share = eased / EASE;
    const float above = app->goal_before - app->land_height, sunk = LAND_SPEED * (elapsed - eased + eased * share / 2);
    *rate = -LAND_SPEED * share - above * 6 * share * (1 - share) / EASE;
    return clip(app->land_height - sunk + above * (1 - share) * (1 - share) * (1 + 2 * share), -1, 10);
}

static void fly(mjxball_app *app, const pair_state *pair, const mjxball_map *map, mjxball_setpoint *out) {
    const float period = (float)mjxball_rig.period / 1000, hover = hover_of(app, map);
    float goal[3], goal_rate = 0;
    for (int i = 0; i < 3; i++) goal[i] = app->origin[i] + app->set.goal[i];
    if (mjxball_rig.stand) goal[0] = goal[1] = 0;
    if (app->phase == MJXBALL_LAND) goal[2] = app->origin[2] + landing_goal(app, &goal_rate);
    if (!mjxball_rig.knows_rates) goal_rate = 0;
    if (!compute_command(app, pair, goal, goal_rate) || app->late > 10) {
        app->copying = 1;
        if (app->phase == MJXBALL_FLY) enter(app, MJXBALL_LAND, app->late > 10 ? MJXBALL_LATE : MJXBALL_BAD_COMMAND, map);
    }
    if (!command_is_good(app)) {
        distrust(app, map, out);
        return;
    }
    if (!send_command(app, map, out)) app->saturated_since = app->now;
    app->trim = clip(app->trim + period * (out->thrust - app->trim), 0.85f * hover, 1.15f * hover);
}

void mjxball_defaults(mjxball_parameters *set) {
    for (int i = 0; i < 3; i++) {
        set->goal[i] = mjxball_rig.goal[i];
        set->mount[i] = 0;
    }
    set->curve = 0;
    set->battery = mjxball_rig.battery;
}

void mjxball_start(mjxball_app *app, uint32_t now) {
    const mjxball_app fresh = {0};
    *app = fresh;
    app->now = app->since = app->charged = now;
    app->trusted = 1;
    mjxball_defaults(&app->set);
}

void mjxball_tick(mjxball_app *app, const mjxball_parameters *set, const mjxball_state *state, uint32_t now,
    mjxball_setpoint *out) {
    const uint8_t fault = adopt(app, set);
    const mjxball_map *map = &mjxball_rig.maps[app->set.curve == 1];
    const uint32_t gap = now - app->now;
    const bool good = state_is_good(state, now);
    pair_state pair = {.level = 1};
    const mjxball_setpoint none = {0};
    *out = none;
    app->late = 0.99f * app->late + (app->started && gap >= 2u * (uint32_t)mjxball_rig.period ? 1.0f : 0.0f);
    app->started = 1;
    app->now = now;
    if (is_charged(app, state)) app->charged = now;
    if (good) {
        estimate_pair(app->set.mount, state, &pair);
        for (int i = 0; i < 3; i++) {
            app->position[i] = pair.position[i];
            app->velocity[i] = pair.velocity[i];
        }
    }
    if (app->phase > MJXBALL_SPIN && !estimate_is_good(state)) app->trusted = 0;
    track_rest(app, good);
    supervise(app, fault, &pair, state, good, map);
    switch (app->phase) {
    case MJXBALL_IDLE:
        break;
    case MJXBALL_SPIN:
        send_level(out, 0, 0, SPIN_THRUST);
        break;
    case MJXBALL_RAMP:
        take_off(app, &pair, map, out);
        break;
    case MJXBALL_FLY:
    case MJXBALL_LAND:
        fly(app, &pair, map, out);
        break;
    case MJXBALL_DESCEND:
        descend(app, good, out);
        break;
    default:
        out->active = true; /* thrust 0 */
        return;
    }
    /* Last check before the commander. */
    if (out->active && !setpoint_is_good(out)) distrust(app, map, out);
    out->thrust = (float)(int)(out->thrust + 0.5f);
}
