"""C text of `control.multi_model_lqg` with `control.swing`, which `c_header` puts into an exported follower."""

MULTI_MODEL_LQG = """
/* LQG for loops of unknown speed; its memory: the filters' states about roll (5 of each model), about pitch, and what
 * the network's lift has turned of the latter, of the height (3), the models' scores about roll and about pitch, the
 * load's swings about roll (4 of each) and about pitch, the slow part of what is added (2), and what it is told of its
 * team (4). */
enum {
    MJXBALL_MODELS = sizeof mjxball_lqg_stiffness / sizeof *mjxball_lqg_stiffness,
    MJXBALL_HEIGHT = 15 * MJXBALL_MODELS,
    MJXBALL_SCORES = MJXBALL_HEIGHT + 3,
    MJXBALL_SWING = MJXBALL_SCORES + 2 * MJXBALL_MODELS,
    MJXBALL_SLOW = MJXBALL_SWING + 8 * MJXBALL_SWINGS,
    MJXBALL_TOLD = MJXBALL_SLOW + 2
};

/* What is known at an observation, about roll and pitch: the models' weights, their mean of 1 over the stiffness,
 * what the load will have grown by when rotors act. */
typedef struct {
    mjxball_real weights[2][MJXBALL_MODELS], soft[2], grown[2];
} mjxball_known;

/* (x, y) in the mount frame as seen from the axes of the filters, with sin = MJXBALL_RIG_SIN; back with minus that. */
static inline void mjxball_turn(mjxball_real *x, mjxball_real *y, mjxball_real sin) {
    mjxball_real along = MJXBALL_RIG_COS * *x + sin * *y;
    *y = MJXBALL_RIG_COS * *y - sin * *x;
    *x = along;
}

/* What lifting turns about the axes of the filters. */
static inline void mjxball_lqg_levers(const mjxball_real *memory, mjxball_real *levers) {
    mjxball_copy(levers, memory + MJXBALL_TOLD + 1, 2);
    mjxball_turn(levers, levers + 1, MJXBALL_RIG_SIN);
}

static inline void mjxball_lqg_start(mjxball_real *memory, const mjxball_real *observation) {
    for (int axis = 0; axis < 2; axis++)
        for (int model = 0; model < MJXBALL_MODELS; model++) {
            mjxball_real *state = memory + 5 * (axis * MJXBALL_MODELS + model);
            state[0] = observation[3 + axis];
            state[1] = observation[9 + axis];
        }
    memory[MJXBALL_HEIGHT] = -observation[17];
    for (int k = 0; k < 4; k++) memory[MJXBALL_TOLD + k] = mjxball_lqg_context[k];
}

/* The models' weights about an axis, and their mean of 1 over the loops' stiffness, which is returned. */
static inline mjxball_real mjxball_lqg_weights(const mjxball_real *memory, int axis, mjxball_real *weights) {
    const mjxball_real *scores = memory + MJXBALL_SCORES + axis * MJXBALL_MODELS;
    mjxball_real sum = 0, soft = 0;
    for (int model = 0; model < MJXBALL_MODELS; model++) sum += weights[model] = mjxball_decay(-scores[model]);
    for (int model = 0; model < MJXBALL_MODELS; model++) {
        weights[model] /= sum;
        soft += weights[model] / mjxball_lqg_stiffness[model];
    }
    return soft;
}

/* The load about an axis as a tilt. */
static inline mjxball_real mjxball_lqg_load(const mjxball_real *memory, int axis, const mjxball_real *weights) {
    const mjxball_real *state = memory + 5 * axis * MJXBALL_MODELS + 2;
    mjxball_real load = 0;
    for (int model = 0; model < MJXBALL_MODELS; model++, state += 5)
        load += weights[model] * *state / mjxball_lqg_stiffness[model];
    return load;
}

#if MJXBALL_SWINGS
/* Swings about an axis as they are once its `load` is known: constants, in phase, in quadrature, energies. */
static inline void mjxball_swing_see(mjxball_real *memory, int axis, mjxball_real load) {
    mjxball_real *state = memory + MJXBALL_SWING + 4 * MJXBALL_SWINGS * axis;
    const float *row = mjxball_lqg_swing;
    for (int j = 0; j < MJXBALL_SWINGS; j++, state++, row += 5) {
        mjxball_real left = load - state[0] - state[MJXBALL_SWINGS], *energy = state + 3 * MJXBALL_SWINGS;
        for (int k = 0; k < 3; k++) state[k * MJXBALL_SWINGS] += row[2 + k] * left;
        *energy = mjxball_lqg_swing_keep[0] * *energy + (1 - mjxball_lqg_swing_keep[0]) * left * left;
    }
}

/* What the load will have grown by when rotors act; `weights` of the models. */
static inline mjxball_real mjxball_swing_grown(
    const mjxball_real *memory, int axis, const mjxball_real *weights) {
    const mjxball_real *state = memory + MJXBALL_SWING + 4 * MJXBALL_SWINGS * axis;
    const mjxball_real *energy = state + 3 * MJXBALL_SWINGS;
    mjxball_real least = energy[0], sum = 0, grown = 0;
    for (int j = 1; j < MJXBALL_SWINGS; j++)
        if (energy[j] < least) least = energy[j];
    for (int j = 0; j < MJXBALL_SWINGS; j++, state++) {
        mjxball_real odds = (least + MJXBALL_LEAST_ENERGY) / (energy[j] + MJXBALL_LEAST_ENERGY), along = 0, across = 0;
        const float *ahead = mjxball_lqg_swing_ahead + 2 * j;
        for (int k = 0; k < MJXBALL_SHARPNESS; k++) odds *= odds;
        for (int model = 0; model < MJXBALL_MODELS; model++, ahead += 2 * MJXBALL_SWINGS) {
            along += weights[model] * ahead[0];
            across += weights[model] * ahead[1];
        }
        sum += odds;
        grown += odds * (along * state[MJXBALL_SWINGS] - across * state[2 * MJXBALL_SWINGS]);
    }
    return grown / sum;
}

static inline void mjxball_swing_next(mjxball_real *memory) {
    for (int axis = 0; axis < 2; axis++) {
        mjxball_real *phase = memory + MJXBALL_SWING + (4 * axis + 1) * MJXBALL_SWINGS;
        const float *row = mjxball_lqg_swing;
        for (int j = 0; j < MJXBALL_SWINGS; j++, phase++, row += 5) {
            mjxball_real *across = phase + MJXBALL_SWINGS, before = *phase;
            *phase = row[0] * before - row[1] * *across;
            *across = row[1] * before + row[0] * *across;
        }
    }
}
#endif

static inline void mjxball_lqg_estimate(
    mjxball_real *memory, const mjxball_real *observation, mjxball_known *known) {
    mjxball_real *height = memory + MJXBALL_HEIGHT, off = -observation[17] - height[0];
    for (int row = 0; row < 3; row++) height[row] += off * mjxball_lqg_height_gain[row];
    for (int axis = 0; axis < 2; axis++) {
        mjxball_real *scores = memory + MJXBALL_SCORES + axis * MJXBALL_MODELS, most = 0;
        const float *gains = axis == 0 ? MJXBALL_ROLL_GAIN : mjxball_lqg_axis_gain;
        const float *certainty = axis == 0 ? MJXBALL_ROLL_CERTAINTY : mjxball_lqg_certainty;
        const float *prior = axis == 0 ? MJXBALL_ROLL_PRIOR : mjxball_lqg_prior;
        for (int model = 0; model < MJXBALL_MODELS; model++) {
            mjxball_real *state = memory + 5 * (axis * MJXBALL_MODELS + model);
            const float *gain = gains + 10 * model, *sure = certainty + 3 * model;
            mjxball_real angle = observation[3 + axis] - state[0], rate = observation[9 + axis] - state[1];
            mjxball_real far;
            for (int row = 0; row < 5; row++) state[row] += angle * gain[2 * row] + rate * gain[2 * row + 1];
            if (axis == 1) {
                mjxball_real *turned = state + 5 * MJXBALL_MODELS, off_angle = -turned[0], off_rate = -turned[1];
                for (int row = 0; row < 5; row++)
                    turned[row] += off_angle * gain[2 * row] + off_rate * gain[2 * row + 1];
                angle += off_angle;
                rate += off_rate;
            }
            far = angle * (sure[0] * angle + 2 * sure[1] * rate) + sure[2] * rate * rate;
            scores[model] = mjxball_lqg_keep[0] * scores[model] + prior[model] - (mjxball_real)0.5 * far;
            if (model == 0 || scores[model] > most) most = scores[model];
        }
        for (int model = 0; model < MJXBALL_MODELS; model++) scores[model] -= most;
        known->soft[axis] = mjxball_lqg_weights(memory, axis, known->weights[axis]);
        known->grown[axis] = 0;
#if MJXBALL_SWINGS
        mjxball_swing_see(memory, axis, mjxball_lqg_load(memory, axis, known->weights[axis]));
        known->grown[axis] = mjxball_swing_grown(memory, axis, known->weights[axis]);
#endif
    }
}

/* Minus the natural logarithm of x, 1 over the stiffness of loops of 4 to 20 rad/s, by Halley. */
static inline mjxball_real mjxball_depth(mjxball_real x) {
    mjxball_real depth = (mjxball_real)4.4;
    for (int k = 0; k < 4; k++) {
        mjxball_real found = mjxball_decay(depth);
        depth += 2 * (found - x) / (found + x);
    }
    return depth;
}

static inline void mjxball_lqg_features(
    const mjxball_real *memory, const mjxball_real *observation, const mjxball_known *known, mjxball_real *to) {
    const mjxball_real *context = memory + MJXBALL_TOLD, *height = memory + MJXBALL_HEIGHT, *soft = known->soft;
    mjxball_lqg_levers(memory, to + 15);
    for (int axis = 0; axis < 2; axis++) {
        const mjxball_real *weights = known->weights[axis];
        mjxball_real mean[5] = {0};
        for (int model = 0; model < MJXBALL_MODELS; model++) {
            const mjxball_real *state = memory + 5 * (axis * MJXBALL_MODELS + model);
            mjxball_real softer = weights[model] / mjxball_lqg_stiffness[model];
            for (int k = 0; k < 5; k++) mean[k] += (k < 2 ? weights[model] : softer) * state[k];
        }
        to[axis] = observation[3 + axis] - mean[0];
        to[2 + axis] = observation[9 + axis] - mean[1];
        mjxball_copy(to + 5 + 3 * axis, mean + 2, 3);
        to[15 + axis] *= soft[axis];
#if MJXBALL_SWINGS
        to[20 + axis] = known->grown[axis];
#endif
    }
#if MJXBALL_SWINGS
    mjxball_turn(to + 20, to + 21, -MJXBALL_RIG_SIN);
#endif
    mjxball_turn(to, to + 1, -MJXBALL_RIG_SIN);
    mjxball_turn(to + 2, to + 3, -MJXBALL_RIG_SIN);
    for (int k = 5; k < 8; k++) mjxball_turn(to + k, to + k + 3, -MJXBALL_RIG_SIN);
    mjxball_turn(to + 15, to + 16, -MJXBALL_RIG_SIN);
    for (int axis = 0; axis < 2; axis++) {
        mjxball_real mixed = soft[axis] + MJXBALL_RIG_SIN * MJXBALL_RIG_SIN * (soft[1 - axis] - soft[axis]);
        to[13 + axis] = (mjxball_real)0.5 * mjxball_depth(mixed);
        to[17 + axis] = context[3] * mixed;
    }
    to[4] = -observation[17] - height[0];
    mjxball_copy(to + 11, height + 1, 2);
    to[19] = context[0];
}

/* own: the law's command about the axes of the filters, to which the network's is added. */
static inline void mjxball_lqg_command(
    const mjxball_real *memory, const mjxball_real *observation, const mjxball_known *known, const mjxball_real *led,
    mjxball_real *own) {
    const mjxball_real *context = memory + MJXBALL_TOLD, share = context[0];
    mjxball_real levers[2], far[2], load[2], room[2], rest[2], most[2], gains[2][4] = {{0}};
    mjxball_real rise = mjxball_lqg_rise[0] * observation[14] + mjxball_lqg_rise[1] * observation[17];
    rise = mjxball_clip(rise, mjxball_lqg_limits[1]) - memory[MJXBALL_HEIGHT + 2];
    own[2] = mjxball_clip(share * rise - (share - 1) * led[2], mjxball_limit[2]);
    mjxball_lqg_levers(memory, levers);
    for (int i = 0; i < 2; i++) {
        const mjxball_real *weights = known->weights[i], soft = known->soft[i];
        mjxball_real damping = 0;
        load[i] = mjxball_lqg_load(memory, i, weights) + known->grown[i] + levers[i] * soft * (own[2] - led[2]);
        for (int model = 0; model < MJXBALL_MODELS; model++) {
            damping += weights[model] * mjxball_lqg_damping[model];
            for (int k = 0; k < 4; k++) gains[i][k] += weights[model] * mjxball_lqg_tilts[4 * model + k];
        }
        rest[i] = observation[3 + i] + damping * observation[9 + i];
        most[i] = context[3] * soft;
        if (most[i] < MJXBALL_LEAST_ROOM) most[i] = MJXBALL_LEAST_ROOM;
    }
    far[0] = -(gains[0][0] * observation[13] + gains[0][1] * observation[16]);
    far[1] = gains[1][0] * observation[12] + gains[1][1] * observation[15];
    mjxball_within(far, mjxball_lqg_limits[0]);
    mjxball_within(load, mjxball_lqg_limits[2]);
#if MJXBALL_SWINGS
    {
        mjxball_real held = mjxball_root(load[0] * load[0] + load[1] * load[1] + (mjxball_real)1e-12);
        held *= MJXBALL_HELD_ROOM * share;
        for (int i = 0; i < 2; i++)
            if (most[i] < held) most[i] = held;
    }
#endif
    most[0] *= MJXBALL_ROLL_ROOM;
    for (int i = 0; i < 2; i++) {
        mjxball_real wanted = far[i] - gains[i][2] * observation[3 + i] - gains[i][3] * observation[9 + i] - load[i];
        own[i] = share * wanted - (share - 1) * led[i];
        room[i] = (own[i] - rest[i]) / most[i];
    }
    mjxball_within(room, 1);
    for (int i = 0; i < 2; i++) own[i] = rest[i] + most[i] * room[i];
}

static inline void mjxball_lqg_next(
    mjxball_real *memory, const mjxball_real *led, const mjxball_real *own, const mjxball_real *command) {
    const mjxball_real *context = memory + MJXBALL_TOLD, share = context[0];
    mjxball_real *slow = memory + MJXBALL_SLOW, *height = memory + MJXBALL_HEIGHT, drive, before[5], levers[2];
    mjxball_real turned[2] = {command[0], command[1]};
    const float *row = mjxball_lqg_height;
#if MJXBALL_SWINGS
    mjxball_swing_next(memory);
#endif
    mjxball_turn(turned, turned + 1, MJXBALL_RIG_SIN);
    mjxball_lqg_levers(memory, levers);
    for (int axis = 0; axis < 3; axis++) {
        mjxball_real mean = 0, turns;
        if (axis < 2) {
            mjxball_real added = turned[axis] - own[axis];
            slow[axis] = mjxball_lqg_keep[1] * slow[axis] + (1 - mjxball_lqg_keep[1]) * added;
            mean = (own[axis] + added - slow[axis] + (share - 1) * led[axis]) / share;
            turns = levers[axis] * (own[2] - led[2]);
        } else {
            turns = mjxball_root(context[1] * context[1] + context[2] * context[2]) * (command[2] - own[2]);
            turns *= mjxball_lqg_added_lift[0] * (share < (mjxball_real)1.5 ? 0 : share > 2 ? 1 : 2 * share - 3);
        }
        for (int model = 0; model < MJXBALL_MODELS; model++) {
            mjxball_real *state = memory + 5 * (axis * MJXBALL_MODELS + model);
            const float *turn = mjxball_lqg_axis + 30 * model;
            drive = mean + turns / mjxball_lqg_stiffness[model];
            mjxball_copy(before, state, 5);
            for (int k = 0; k < 5; k++, turn += 6) {
                state[k] = turn[5] * drive;
                for (int j = 0; j < 5; j++) state[k] += turn[j] * before[j];
            }
        }
    }
    drive = (own[2] + (share - 1) * led[2]) / share;
    mjxball_copy(before, height, 3);
    for (int k = 0; k < 3; k++, row += 4) {
        height[k] = row[3] * drive;
        for (int j = 0; j < 3; j++) height[k] += row[j] * before[j];
    }
}
"""
