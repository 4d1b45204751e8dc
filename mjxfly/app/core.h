/* One drone of a pair on board: controllers, supervisor, peer to peer, upload. Functions on structs, no firmware types.
 *
 * Compiled once with MJXBALL_FOLLOWER 0 for the leader (PID) and once with 1 for the follower (policy). `policy.h` and
 * `rig.h` are generated from a policy file. SI units, radians, world axes; times in milliseconds of the drone's clock.
 */
#ifndef MJXBALL_CORE_H
#define MJXBALL_CORE_H

#include <stdbool.h>
#include <stdint.h>

#include "policy.h"

/* Only a follower with integer weights accepts uploads. */
#if MJXBALL_FOLLOWER && defined(MJXBALL_INT8)
#define MJXBALL_UPLOADS 1
#else
#define MJXBALL_UPLOADS 0
#endif

/* In order of precedence: a drone enters the highest phase that itself, the laptop or the other drone requests. */
typedef enum {
    MJXBALL_IDLE,     /* no setpoints: those of the laptop are executed */
    MJXBALL_SPIN,     /* level, a third of hover */
    MJXBALL_RAMP,     /* level, thrust rising to hover */
    MJXBALL_FLY,      /* controller */
    MJXBALL_LAND,     /* controller with a sinking goal */
    MJXBALL_DESCEND,  /* braking sideways, sinking */
    MJXBALL_STOP,     /* motors off, until the firmware no longer counts as flying */
} mjxball_phase;

/* Why a drone does not start, or entered its phase. `rig.h` has a sentence for each, from `protocol.CAUSES`. */
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
    float hover, per_acceleration; /* the paper's thrust map [thrust units, thrust units per m/s2] */
    float quadratic, linear;       /* force of a motor at p = thrust / 65535: quadratic p^2 + linear p [N] */
    int known;                     /* whether the policy flies with firmware of this force curve */
} mjxball_map;

/* Contents of `rig.h`. */
typedef struct {
    uint32_t ident;        /* CRC of the weights */
    uint32_t key;          /* compatibility key, without the weights: both drones and an upload must agree */
    int period;            /* of the controller [ms] */
    float mount[2][3];     /* of leader and follower as trained [m] */
#ifdef MJXBALL_MOUNT_ANGLE
    float mount_frame[2];  /* cosine and sine of the angle about body z by which the policy's axes are rotated */
#endif
    float carried[2];      /* nominal mass that each drone lifts [kg] */
    float kp[3], kd[3], ki[3], band[3], lead; /* the leader's controller, see sim/controllers.py */
    int stand;             /* only height and roll are free */
    int own_error;         /* the leader's error is that of its mount, not of O */
    int knows_rates;       /* the follower was trained with goals that move */
    int paper;             /* 1: thrust by the paper's map, 0: by the force curve */
    float goal[3];         /* from the start [m] */
    float fence_low[3], fence_high[3];
    float land_spare;      /* [s] */
    float battery;         /* [V] */
    mjxball_map maps[2];   /* firmware with battery compensation, and without */
} mjxball_rig_parameters;

typedef struct {
    float goal[3];  /* of O from its start [m] */
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

#define MJXBALL_BEAT_SIZE 24
#define MJXBALL_REPLY_SIZE 8

/* Heartbeat of the other drone. */
typedef struct {
    uint32_t key;
    uint8_t phase, trusted;
    float velocity[3]; /* of O [m/s] */
    float apart;       /* half difference of the drones' lifts that its take-off found [hover] */
} mjxball_beat;

typedef struct {
    uint8_t phase, cause, refusal, order;
    uint8_t copying;  /* the fallback controller replaces the network */
    uint8_t trusted;  /* the estimate of this drone can be used */
    uint8_t started;
    uint32_t since, now, laptop_time, peer_time, saturated_since, charged;
    float late;       /* number of late ticks, with exponential decay within about a second */
    mjxball_parameters set; /* in use */
    float origin[3], land_height, goal_before; /* heights above the origin where a landing began, and of its goal then */
    float position[3], velocity[3]; /* of O */
    float integral[3]; /* of the leader's error [m s] */
    float trim;       /* hover thrust [thrust units] */
    float climb, height; /* model of a descent without estimates */
    float share, apart, resting; /* of the take-off: mean lift, half difference [hover], angle at rest [rad] */
    float needed; /* hover force of this drone with a level stick over the nominal one, found by the take-off */
    uint32_t low_since; /* since then it has not sunk more than RESTING below `low` [m] */
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
/* The controller's period [ms], and the CRC of the weights in use. */
int mjxball_period(void);
uint32_t mjxball_ident(const mjxball_app *app);
/* Parameters at boot: the policy's goal and battery limit, no mount. */
void mjxball_defaults(mjxball_parameters *set);
void mjxball_start(mjxball_app *app, uint32_t now);
/* Once a period. */
void mjxball_tick(mjxball_app *app, const mjxball_parameters *set, const mjxball_state *state, uint32_t now,
    mjxball_setpoint *out);
/* Writes the heartbeat for the other drone; handles one of the other drone. */
void mjxball_send(const mjxball_app *app, uint8_t out[MJXBALL_BEAT_SIZE]);
void mjxball_hear(mjxball_app *app, const uint8_t *data, int size, uint32_t now);
/* Handles a packet of the laptop; returns the reply's length, 0 for none. `memory` holds uploaded weights. */
int mjxball_laptop(mjxball_app *app, const uint8_t *data, int size, uint32_t now, uint8_t *memory,
    uint8_t reply[MJXBALL_REPLY_SIZE]);
/* Bytes of uploaded weights, 0 without uploads. */
uint32_t mjxball_upload_size(void);

#endif
