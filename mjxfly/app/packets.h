/* Radio packets: heartbeats, requests of the laptop, uploads of weights. Part of core.c. */
#ifndef MJXBALL_PACKETS_H
#define MJXBALL_PACKETS_H

#include "core.h"

#include "checks.h"
#include "rig.h"

/* Little-endian, the byte order of all supported machines. */

static void copy(void *to, const void *from, unsigned size) {
    __builtin_memcpy(to, from, size);
}

void mjxball_send(const mjxball_app *app, uint8_t out[MJXBALL_BEAT_SIZE]) {
    out[0] = 'M';
    out[1] = MJXBALL_FOLLOWER;
    out[2] = app->phase;
    out[3] = app->trusted;
    copy(out + 4, &mjxball_rig.key, 4);
    copy(out + 8, app->velocity, 12);
    copy(out + 20, &app->apart, 4);
}

void mjxball_hear(mjxball_app *app, const uint8_t *data, int size, uint32_t now) {
    mjxball_beat beat;
    if (size != MJXBALL_BEAT_SIZE || data[0] != 'M' || data[1] != !MJXBALL_FOLLOWER) return;
    if (data[2] > MJXBALL_STOP || data[3] > 1) return;
    beat.phase = data[2];
    beat.trusted = data[3];
    copy(&beat.key, data + 4, 4);
    if (app->phase != MJXBALL_IDLE && beat.key != mjxball_rig.key) return; /* of another pair */
    copy(beat.velocity, data + 8, 12);
    copy(&beat.apart, data + 20, 4);
    if (!within(beat.velocity, 3, MOST_SPEED) || !within(&beat.apart, 1, APART)) return;
    app->peer = beat;
    app->peer_time = now ? now : 1;
}

/* Weights. */

#if MJXBALL_UPLOADS
static uint32_t crc32_of(const uint8_t *data, uint32_t size) {
    uint32_t crc = 0xFFFFFFFFu;
    for (uint32_t k = 0; k < size; k++) {
        crc ^= data[k];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320u : 0u);
    }
    return ~crc;
}

static uint32_t word(const uint8_t *data) {
    uint32_t value;
    copy(&value, data, 4);
    return value;
}

/* Whether the float parameters in front of the integer weights are finite and of plausible size. */
static bool weights_are_good(const uint8_t *memory) {
    const float most = 1e6f;
    float value;
    for (uint32_t at = 0; at < __builtin_offsetof(mjxball_weights, weight_0); at += 4) {
        copy(&value, memory + at, 4);
        if (!within(&value, 1, most)) return false;
    }
    return true;
}

/* Handles a packet of an upload: begin (key, size, CRC), chunk (offset, bytes) or commit. Returns a cause. */
static uint8_t take(mjxball_app *app, const uint8_t *data, int size, uint8_t *memory) {
    const uint8_t kind = data[0];
    if (app->phase != MJXBALL_IDLE) return MJXBALL_NOT_ON_GROUND;
    if (kind == 2) {
        app->follower.weights = 0; /* the memory is about to change */
        app->upload.ready = size == 13 && word(data + 1) == mjxball_rig.key && word(data + 5) == mjxball_upload_size();
        if (!app->upload.ready) return MJXBALL_BAD_UPLOAD;
        app->upload.size = word(data + 5);
        app->upload.crc = word(data + 9);
        app->upload.received = 0;
        return MJXBALL_GOOD;
    }
    if (!app->upload.ready) return MJXBALL_BAD_UPLOAD;
    if (kind == 3) {
        uint32_t at = size > 5 ? word(data + 1) : 0, count = size > 5 ? (uint32_t)size - 5 : 0;
        if (!count || at > app->upload.received || at + count > app->upload.size) return MJXBALL_BAD_UPLOAD;
        copy(memory + at, data + 5, count);
        if (at + count > app->upload.received) app->upload.received = at + count;
        return MJXBALL_GOOD;
    }
    app->upload.ready = 0;
    if (app->upload.received != app->upload.size || crc32_of(memory, app->upload.size) != app->upload.crc)
        return MJXBALL_BAD_UPLOAD;
    if (!weights_are_good(memory)) return MJXBALL_BAD_UPLOAD;
    app->follower.weights = (const mjxball_weights *)(const void *)memory;
    return MJXBALL_GOOD;
}

uint32_t mjxball_upload_size(void) {
    return sizeof(mjxball_weights);
}
#else
static uint8_t take(mjxball_app *app, const uint8_t *data, int size, uint8_t *memory) {
    (void)app, (void)data, (void)size, (void)memory;
    return MJXBALL_BAD_UPLOAD;
}

uint32_t mjxball_upload_size(void) {
    return 0;
}
#endif

int mjxball_laptop(mjxball_app *app, const uint8_t *data, int size, uint32_t now, uint8_t *memory,
    uint8_t reply[MJXBALL_REPLY_SIZE]) {
    uint32_t received;
    if (size == 2 && data[0] == 1 && data[1] <= MJXBALL_STOP) {
        app->order = data[1];
        app->laptop_time = now ? now : 1;
        return 0;
    }
    if (size < 1 || data[0] < 2 || data[0] > 4) return 0;
    reply[0] = data[0];
    reply[1] = take(app, data, size, memory);
    received = app->upload.received;
    reply[2] = reply[3] = 0;
    copy(reply + 4, &received, 4);
    return MJXBALL_REPLY_SIZE;
}

#endif
