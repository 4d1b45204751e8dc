/* Everything at once into one drone's app: `fuzz TICKS SEED`, built by onboard_fuzz.py with sanitizers.
 *
 * Flights of a pair that is held in the hand. Any number of a state, a parameter, a packet or an upload may be wild,
 * calls come in any order, and in some flights the app's own numbers are spoilt, too. Prints what was reached, or one
 * line and exit 1 for an output outside the limits.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core.c"

#define MTU 64
#define NAN __builtin_nanf("")

/* Chance. */
static uint64_t chance;
static uint32_t bits(void) {
    chance ^= chance >> 12;
    chance ^= chance << 25;
    chance ^= chance >> 27;
    return (uint32_t)((chance * 0x2545F4914F6CDD1Du) >> 32);
}
static uint32_t below(uint32_t count) {
    return (uint32_t)(((uint64_t)bits() * count) >> 32);
}
static bool once_in(uint32_t count) { /* never in 0 */
    return count && !below(count);
}
static float noise(float size) {
    return size * ((float)below(2001) / 1000 - 1);
}
static void wilden(float *values, uint32_t count, uint32_t rate) {
    static const float odd[] = {0, -0.0f, 1e-45f, 1e-38f, 1e-7f, 0.05f, -0.3f, 1, -1, 4, 11, 49, 90, 999, -1001, 9e4f, 1e6f,
        -1e9f, 2.2e9f, -1e19f, 1e30f, 1e38f, -1e38f, 3.4e38f, -3.4e38f, __builtin_inff(), -__builtin_inff(), NAN, NAN, NAN};
    for (uint32_t k = 0; k < count; k++) {
        const uint32_t any = bits();
        if (!once_in(rate)) continue;
        if (once_in(4)) memcpy(values + k, &any, 4);
        else values[k] = odd[below(sizeof odd / sizeof *odd)];
    }
}

/* One flight. */
static struct {
    uint32_t states, sets, beats, orders, uploads, clock, memory; /* one in so many is wild; 0: none */
} rate;
static mjxball_app app;
static mjxball_parameters set, sound;
static uint8_t *packets[MTU + 1], *memory, *fresh;
static uint32_t now, ticks, flights, accepted, refused, phases[MJXBALL_STOP + 1], causes[MJXBALL_CAUSES], refusals[MJXBALL_CAUSES];
static float place[3], speed[3];
static uint8_t wanted;

static void fail(const char *what, const mjxball_setpoint *out) {
    printf("tick %u, phase %d, cause %d: %s: active %d, roll %g, pitch %g, thrust %g\n", ticks, app.phase, app.cause, what,
        out->active, (double)out->roll, (double)out->pitch, (double)out->thrust);
    exit(1);
}

static void check(const mjxball_setpoint *out, uint8_t before) {
    const bool level = out->roll == 0 && out->pitch == 0 && out->thrust == 0;
    if (app.phase > MJXBALL_STOP || app.cause >= MJXBALL_CAUSES || app.refusal >= MJXBALL_CAUSES) fail("no phase", out);
    if (app.phase < before && app.phase != MJXBALL_IDLE) fail("back to an old phase", out);
    if (app.phase == MJXBALL_IDLE && before != MJXBALL_IDLE && before != MJXBALL_STOP) fail("silent in flight", out);
    if (before == MJXBALL_IDLE && app.phase > MJXBALL_SPIN) fail("off without spinning", out);
    if (out->active != (app.phase != MJXBALL_IDLE)) fail("sent, or not sent", out);
    if (app.phase == MJXBALL_IDLE || app.phase == MJXBALL_STOP) {
        if (!level) fail("motors are not off", out);
        return;
    }
    if (!within(&out->roll, 1, 15.001f) || !within(&out->pitch, 1, 15.001f)) fail("angle beyond the limits", out);
    if (!(out->thrust >= 10001 && out->thrust <= 60000)) fail("thrust beyond the limits", out);
    if ((app.phase == MJXBALL_FLY || app.phase == MJXBALL_LAND) && !within(app.command, 3, 1000))
        fail("a controller that commands no numbers flies on", out);
    if (rate.memory) return;
    if (!within(app.command, 3, 100) || !within(app.integral, 3, 1e6f) || !within(app.velocity, 3, 200)
        || !within(app.position, 3, 2000) || !within(app.origin, 3, 2000) || !within(&app.trim, 1, 60000)
        || !within(&app.height, 1, 2000) || !within(&app.climb, 1, 200) || !within(app.set.mount, 3, 1)
        || !within(app.set.goal, 3, 1000) || !within(&app.peer.apart, 1, 1000) || !within(app.peer.velocity, 3, 50))
        fail("the app remembers what it must not", out);
#if MJXBALL_MEMORY_SIZE > 0 && MJXBALL_FOLLOWER
    if (app.follower.running && !within(app.follower.memory, MJXBALL_MEMORY_SIZE, 3e38f))
        fail("the policy remembers what is not finite", out);
#endif
}

/* Inputs, in packets of which not a byte more may be read. */
static void hear(void) {
    float numbers[4]; /* velocity, half difference of the lifts */
    const int size = once_in(rate.beats) ? (int)below(MTU) : MJXBALL_BEAT_SIZE;
    uint8_t full[MTU] = {'M', !MJXBALL_FOLLOWER, app.phase, 1};
    for (int k = 0; k < 4; k++) numbers[k] = noise(0.02f);
    wilden(numbers, 4, rate.beats);
    copy(full + 4, &mjxball_rig.key, 4);
    copy(full + 8, numbers, sizeof numbers);
    if (once_in(rate.beats)) full[2] = (uint8_t)below(9);
    if (once_in(rate.beats)) full[below(MJXBALL_BEAT_SIZE)] = (uint8_t)bits();
    copy(packets[size], full, (unsigned)size);
    mjxball_hear(&app, packets[size], size, now);
}

static uint8_t *to_app(const uint8_t *data, int size) {
    static uint8_t reply[MJXBALL_REPLY_SIZE];
    copy(packets[size], data, (unsigned)size);
    reply[1] = 255;
    mjxball_laptop(&app, packets[size], size, now, memory, reply);
    return reply;
}

static void order(void) {
    uint8_t data[MTU];
    for (int k = 0; k < MTU; k++) data[k] = (uint8_t)bits();
    data[0] = once_in(rate.orders) ? (uint8_t)below(6) : 1;
    data[1] = once_in(rate.orders) ? (uint8_t)below(9) : wanted;
    to_app(data, data[0] == 1 && !once_in(rate.orders) ? 2 : (int)below(32));
}

/* Whole weights with a right CRC, of which packets may be lost, doubled or changed, and floats may be wild. */
static void upload(void) {
#if MJXBALL_UPLOADS
    const uint32_t total = mjxball_upload_size(), floats = __builtin_offsetof(mjxball_weights, weight_0);
    const uint32_t harm = once_in(2) ? 256u << below(8) : 0;
    const uint8_t phase = app.phase;
    const mjxball_setpoint none = {0};
    const mjxball_weights *const before = app.follower.weights;
    uint32_t head[3] = {mjxball_rig.key, total, 0};
    uint8_t data[MTU] = {2};
    copy(fresh, &mjxball_compiled, total);
    for (int k = 0; k < 50; k++) fresh[floats + below(total - floats)] = (uint8_t)bits();
    if (once_in(2)) wilden((float *)(void *)fresh, floats / 4, once_in(2) ? 3 : 300);
    head[2] = crc32_of(fresh, total);
    if (once_in(harm)) head[below(3)] ^= 1u << below(32);
    copy(data + 1, head, 12);
    to_app(data, 13);
    data[0] = 3;
    for (uint32_t at = 0; at < total; at += 24) {
        const uint32_t rest = total - at, said = once_in(harm) ? bits() >> below(32) : at;
        const uint32_t given = rest < 24 ? rest : 24, told = harm && (rest < 24 || once_in(harm)) ? below(MTU - 4) : given;
        if (once_in(harm)) continue;
        copy(data + 1, &said, 4);
        copy(data + 5, fresh + at, given);
        to_app(data, (int)(5 + told));
        if (once_in(harm)) order();
    }
    data[0] = 4;
    if (!to_app(data, 1)[1]) accepted++;
    else refused++;
    if (phase != MJXBALL_IDLE && app.follower.weights != before) fail("weights changed in flight", &none);
    if (app.follower.weights && !within(app.follower.weights->mean, (int)floats / 4, 1e6f)) fail("wild weights", &none);
#endif
}

static void look_around(mjxball_state *state) {
    const float sink = app.phase >= MJXBALL_LAND ? -0.3f : app.phase == MJXBALL_FLY ? 0.4f : 0;
    for (int i = 0; i < 3; i++) {
        speed[i] = 0.95f * speed[i] + noise(0.01f);
        place[i] = 0.999f * place[i] + 0.01f * speed[i];
        state->velocity[i] = speed[i];
        state->rates[i] = noise(0.1f);
        state->variance[i] = 1e-5f;
    }
    place[2] += 0.01f * sink;
    if (place[2] < 0 || place[2] > 0.5f) place[2] = place[2] < 0 ? 0 : 0.5f;
    for (int i = 0; i < 3; i++) state->position[i] = place[i] + sound.mount[i];
    state->quaternion[0] = 1;
    for (int i = 1; i < 4; i++) state->quaternion[i] = noise(0.03f);
    state->voltage = 4;
    state->time = now;
    state->can_fly = !once_in(20 * rate.states);
    wilden(state->position, 3, rate.states);
    wilden(state->velocity, 3, rate.states);
    wilden(state->quaternion, 4, rate.states);
    wilden(state->rates, 3, rate.states);
    if (once_in(rate.states)) { /* any attitude */
        float size = 0;
        for (int i = 0; i < 4; i++) size += state->quaternion[i] * state->quaternion[i];
        state->quaternion[below(4)] = 1;
        state->quaternion[0] = root(2 - size);
    }
    wilden(state->variance, 3, rate.states);
    wilden(&state->voltage, 1, rate.states);
    if (once_in(rate.states)) state->time += bits() >> below(32);
}

static void spoil(void) {
    float *const own[] = {app.origin, &app.land_height, &app.goal_before, app.position, app.velocity, app.integral, &app.trim,
        &app.climb, &app.height, app.action, app.command, &app.peer.apart, app.peer.velocity, &app.late, app.set.goal, app.set.mount,
        &app.set.battery, &app.share, &app.apart, &app.resting, &app.low};
    const uint32_t sizes[] = {3, 1, 1, 3, 3, 3, 1, 1, 1, 3, 3, 1, 3, 1, 3, 3, 1, 1, 1, 1, 1};
    for (uint32_t k = 0; k < sizeof sizes / sizeof *sizes; k++) wilden(own[k], sizes[k], rate.memory);
#if MJXBALL_MEMORY_SIZE > 0 && MJXBALL_FOLLOWER
    wilden(app.follower.memory, MJXBALL_MEMORY_SIZE, 20 * rate.memory);
#endif
}

static void tick(void) {
    mjxball_state state;
    mjxball_setpoint out;
    const uint8_t before = app.phase, refusal = app.refusal;
    uint8_t beat[MJXBALL_BEAT_SIZE];
    look_around(&state);
    if (once_in(rate.sets)) set = sound;
    wilden(set.goal, 3, 9 * rate.sets);
    wilden(set.mount, 3, 9 * rate.sets);
    wilden(&set.battery, 1, 9 * rate.sets);
    if (once_in(9 * rate.sets)) set.curve = (uint8_t)bits();
    if (once_in(rate.memory)) spoil();
    mjxball_tick(&app, &set, &state, now, &out);
    check(&out, before);
    mjxball_send(&app, beat);
    phases[app.phase]++;
    if (app.phase != before) causes[app.cause]++;
    if (app.refusal != refusal) refusals[app.refusal]++;
    ticks++;
}

static void flight(uint32_t left) {
    static const uint32_t rates[] = {0, 0, 0, 3, 30, 300, 3000, 30000};
    const uint32_t length = 50 + below(below(3) ? 400 : 2500), ends = below(length);
    const bool spoilt = rate.memory != 0;
    for (uint32_t *one = &rate.states; one <= &rate.clock; one++) *one = rates[below(sizeof rates / sizeof *rates)];
    rate.memory = once_in(4) ? 2 + below(60) : 0;
    now = bits();
    for (int i = 0; i < 3; i++) place[i] = speed[i] = 0;
    set = sound;
    if (once_in(2) || spoilt) mjxball_start(&app, now);
    if (once_in(9)) upload();
    for (uint32_t k = 0; k < length && k < left; k++) {
        now += once_in(rate.clock) ? bits() >> below(32) : (uint32_t)mjxball_rig.period;
        wanted = k < 5 ? MJXBALL_IDLE : k < 20 ? MJXBALL_SPIN : k < 40 ? MJXBALL_RAMP : MJXBALL_FLY;
        if (k > ends && wanted == MJXBALL_FLY) wanted = MJXBALL_LAND;
        for (uint32_t calls = 2; calls--;) {
            if (!once_in(rate.orders)) order();
            if (!once_in(rate.beats)) hear();
            if (once_in(300 * rate.uploads)) upload();
        }
        tick();
        if (once_in(app.phase == MJXBALL_STOP ? 60 : app.phase == MJXBALL_IDLE && k > 100 ? 20 : 0)) break;
    }
    flights++;
}

static void list(const char *name, const uint32_t *counts, int count) {
    printf(", \"%s\": [%u", name, counts[0]);
    for (int k = 1; k < count; k++) printf(", %u", counts[k]);
    printf("]");
}

int main(int count, char **arguments) {
    const uint32_t wanted_ticks = count == 3 ? (uint32_t)strtoul(arguments[1], 0, 10) : 0;
    chance = count == 3 ? 2 * strtoul(arguments[2], 0, 10) + 1 : 1;
    for (int k = 0; k < 20; k++) bits();
    for (unsigned size = 0; size <= MTU; size++) packets[size] = malloc(size ? size : 1);
    memory = malloc(mjxball_upload_size() ? mjxball_upload_size() : 1);
    fresh = malloc(mjxball_upload_size() + 1);
    mjxball_defaults(&sound);
    for (int i = 0; i < 3; i++) sound.mount[i] = mjxball_rig.mount[MJXBALL_FOLLOWER][i];
    sound.curve = !mjxball_rig.maps[0].known;
    mjxball_start(&app, 0);
    while (ticks < wanted_ticks) flight(wanted_ticks - ticks);
    printf("{\"ticks\": %u, \"flights\": %u, \"accepted\": %u, \"refused\": %u", ticks, flights, accepted, refused);
    list("phases", phases, MJXBALL_STOP + 1);
    list("causes", causes, MJXBALL_CAUSES);
    list("refusals", refusals, MJXBALL_CAUSES);
    puts("}");
    return 0;
}
