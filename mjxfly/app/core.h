/* One drone of a pair on board: laws, supervisor, peer to peer, upload. Pure functions over structs, no firmware types.
 *
 * Compiled once with MJXBALL_FOLLOWER 0 for the leader (PID) and once with 1 for the follower (policy). `policy.h` and
 * `rig.h` are made from a policy file. SI units, radians, world axes; times in milliseconds of the drone's clock.
 */
#ifndef MJXBALL_CORE_H
#define MJXBALL_CORE_H

#include <stdbool.h>
#include <stdint.h>

#include "policy.h"

/* Weights can be uploaded to a follower that has them as whole numbers. */
#if MJXBALL_FOLLOWER && defined(MJXBALL_INT8)
#define MJXBALL_UPLOADS 1
#else
#define MJXBALL_UPLOADS 0
#endif

/* In order of precedence: a drone moves on to the furthest of its own, the laptop's and the other drone's. */
typedef enum {
    MJXBALL_IDLE,     /* nothing is sent: the laptop's setpoints hold */
    MJXBALL_SPIN,     /* level, a third of hover */
    MJXBALL_RAMP,     /* level, thrust rising to hover */
    MJXBALL_FLY,      /* the law */
    MJXBALL_LAND,     /* the law toward a goal that sinks */
    MJXBALL_DESCEND,  /* braking sideways, sinking */
    MJXBALL_STOP,     /* motors off, until the firmware no longer counts as flying */
} mjxball_phase;

/* Why a drone does not start, or why it moved on. `rig.h` has a sentence for each, of `protocol.CAUSES`. */
typedef enum {
    MJXBALL_GOOD,
    MJXBALL_ASKED,       /* by the laptop */
    MJXBALL_PEER,        /* the other drone did */
    MJXBALL_NO_LAPTOP,
    MJXBALL_NO_PEER,
    MJXBALL_OTHER_POLICY,
    MJXBALL_NO_MOUNT,
    MJXBALL_BAD_GOAL,
    MJXBALL_BAD_CURVE,
    MJXBALL_BAD_STATE,
    MJXBALL_BAD_COMMAND, /* not finite, or beyond the limits */
    MJXBALL_ESTIMATOR,
    MJXBALL_FENCE,
    MJXBALL_TILT,
    MJXBALL_CANNOT_FLY,
    MJXBALL_SATURATED,
    MJXBALL_LATE,
    MJXBALL_TIMEOUT,
    MJXBALL_DOWN,        /* it stands on the ground */
    MJXBALL_BAD_UPLOAD,
    MJXBALL_NOT_ON_GROUND,
    MJXBALL_BATTERY,     /* low */
    MJXBALL_BAD_BATTERY, /* the parameter */
    MJXBALL_CAUSES,
} mjxball_cause;

typedef struct {
    float hover, per_acceleration; /* the paper's law [thrust units, thrust units per m/s2] */
    float quadratic, linear;       /* force of a motor at p = thrust / 65535: quadratic p^2 + linear p [N] */
    int known;                     /* whether the policy flies with firmware of this force curve */
} mjxball_map;

/* What `rig.h` holds. */
typedef struct {
    uint32_t ident;        /* of the weights: CRC */
    uint32_t key;          /* of all but weights: both drones and an upload must agree */
    int period;            /* of the law [ms] */
    float mount[2][3];     /* of leader and follower as trained [m] */
#ifdef MJXBALL_MOUNT_ANGLE
    float mount_frame[2];  /* cosine and sine of the angle about body z by which the policy's axes are turned */
#endif
    float carried[2];      /* mass that each believes it lifts [kg] */
    float kp[3], kd[3], ki[3], band[3], lead, tilt_gain; /* the leader's law, see sim/laws.py */
    int axis;              /* 0 roll, 1 pitch: what the load turns */
    float lift_sign;       /* of the axis: a leader that lifts more turns the stick up or down */
    int shares;            /* the follower's base is the leader's PID */
    int stand;             /* only height and roll are free */
    int own_error;         /* the leader flies on its own place's error */
    int paper;             /* thrust law */
    float goal[3];         /* from the start [m] */
    float fence_low[3], fence_high[3];
    float land_spare;      /* [s] */
    float battery;         /* [V] */
    mjxball_map maps[2];   /* firmware with battery compensation, and without */
} mjxball_rig_numbers;

typedef struct {
    float goal[3];  /* of O from where it stood at the start [m] */
    float mount[3]; /* of this drone from O, body axes [m]; 0 0 0: not set */
    uint8_t curve;  /* of the firmware: 0 linear, 1 older */
    float battery;  /* land below it [V] */
} mjxball_parameters;

typedef struct {
    float position[3], velocity[3]; /* world [m, m/s] */
    float quaternion[4];            /* w, x, y, z; body -> world */
    float rates[3];                 /* body axes [rad/s] */
    float variance[3];              /* of the position [m2] */
    float voltage;                  /* of the battery [V] */
    uint32_t time;                  /* [ms] */
    bool can_fly;                   /* the firmware's supervisor lets motors run */
} mjxball_state;

typedef struct {
    bool active;              /* false: send nothing */
    float roll, pitch;        /* [deg], the firmware's signs: negative pitch moves toward +x */
    float thrust;             /* [thrust units] */
} mjxball_setpoint;

#define MJXBALL_BEAT_SIZE 40
#define MJXBALL_REPLY_SIZE 8

/* What a drone hears from the other one. */
typedef struct {
    uint32_t key;
    uint8_t phase, trusted;
    float integral[4]; /* of the leader: its error [m s], the stick's angle error [rad s] */
    float velocity[3]; /* of O [m/s] */
    float apart;       /* of its take-off [share of hover] */
} mjxball_beat;

typedef struct {
    uint8_t phase, cause, refusal, order;
    uint8_t copying;  /* the copying law flies in the network's place */
    uint8_t trusted;  /* its own estimate */
    uint8_t started;
    uint32_t since, now, laptop_time, peer_time, saturated_since, charged;
    float late;       /* ticks that came late, forgotten within a second or so */
    mjxball_parameters set; /* in use */
    float origin[3], land_height;
    float position[3], velocity[3]; /* of O */
    float integral[7];
    float trim;       /* thrust that hovers [thrust units] */
    float climb, height; /* of a descent that is flown blind */
    float share, apart, resting; /* of the take-off: lift of both, their difference [shares of hover], the stick's angle [rad] */
    float needed; /* force by which this drone hovers with the stick level, of what the card says, as the take-off found it */
    uint32_t low_since; /* it has not sunk since then by more than RESTING from `low` [m] */
    float low;
    float action[3], command[3];
    mjxball_beat peer;
    mjxball_follower follower;
    struct {
        uint32_t size, crc, received;
        uint8_t ready;
    } upload;
} mjxball_app;

const char *mjxball_text(int cause);
/* The law's period [ms], and the CRC of the weights in use. */
int mjxball_period(void);
uint32_t mjxball_ident(const mjxball_app *app);
/* Parameters as they are at boot: the policy's goal and drone, no mount. */
void mjxball_defaults(mjxball_parameters *set);
void mjxball_start(mjxball_app *app, uint32_t now);
/* Once a period. */
void mjxball_tick(mjxball_app *app, const mjxball_parameters *set, const mjxball_state *state, uint32_t now,
    mjxball_setpoint *out);
/* The heartbeat for the other drone, and one that came from there. */
void mjxball_send(const mjxball_app *app, uint8_t out[MJXBALL_BEAT_SIZE]);
void mjxball_hear(mjxball_app *app, const uint8_t *data, int size, uint32_t now);
/* A packet of the laptop; the length of what is to be answered, 0 for nothing. `memory` holds uploaded weights. */
int mjxball_laptop(mjxball_app *app, const uint8_t *data, int size, uint32_t now, uint8_t *memory,
    uint8_t reply[MJXBALL_REPLY_SIZE]);
/* Bytes that uploaded weights need, 0 where there can be none. */
uint32_t mjxball_upload_size(void);

#endif
