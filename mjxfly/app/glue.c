/* The core on a Crazyflie, by the public interface of the firmware 2026.08.
 *
 * The out-of-tree controller only copies the state and then calls the firmware's PID. Controller and network run in the
 * app's task, which has a lower priority, and send setpoints to the commander.
 */
#include <stdatomic.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "FreeRTOS.h"
#include "task.h"

#include "app.h"
#include "app_channel.h"
#include "commander.h"
#include "controller.h"
#include "controller_pid.h"
#include "log.h"
#include "param.h"
#include "radiolink.h"
#include "stabilizer_types.h"
#include "supervisor.h"
#include "usec_time.h"

#define DEBUG_MODULE "MJXBALL"
#include "debug.h"

#include "core.h"

#define BEAT_TICKS 2 /* periods between two heartbeats */

static mjxball_app core;
static mjxball_parameters set;
static uint32_t ident, used, laptopAge, peerAge;
static float thrust;
static uint8_t role = MJXBALL_FOLLOWER, period;
#if MJXBALL_UPLOADS
static mjxball_weights uploaded;
#define MEMORY ((uint8_t *)&uploaded)
#else
#define MEMORY ((uint8_t *)0)
#endif

/* Written by tasks of higher priority, with the number of writes. */
static volatile uint32_t stateCount, beatCount;
static mjxball_state newest;
static uint8_t beat[MJXBALL_BEAT_SIZE];

/* Copies data of another task, again if it was written meanwhile; returns its `count`. */
static uint32_t copy_consistent(void *to, const void *from, size_t size, const volatile uint32_t *count) {
    uint32_t before;
    do {
        before = *count;
        atomic_signal_fence(memory_order_seq_cst);
        memcpy(to, from, size);
        atomic_signal_fence(memory_order_seq_cst);
    } while (before != *count);
    return before;
}

void controllerOutOfTreeInit(void) {
    controllerPidInit();
}

bool controllerOutOfTreeTest(void) {
    return controllerPidTest();
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
    const state_t *state, const stabilizerStep_t stabilizerStep) {
    const float radians = 0.017453293f;
    newest.position[0] = state->position.x;
    newest.position[1] = state->position.y;
    newest.position[2] = state->position.z;
    newest.velocity[0] = state->velocity.x;
    newest.velocity[1] = state->velocity.y;
    newest.velocity[2] = state->velocity.z;
    newest.quaternion[0] = state->attitudeQuaternion.w;
    newest.quaternion[1] = state->attitudeQuaternion.x;
    newest.quaternion[2] = state->attitudeQuaternion.y;
    newest.quaternion[3] = state->attitudeQuaternion.z;
    newest.rates[0] = radians * sensors->gyro.x;
    newest.rates[1] = radians * sensors->gyro.y;
    newest.rates[2] = radians * sensors->gyro.z;
    newest.time = T2M(xTaskGetTickCount());
    atomic_signal_fence(memory_order_seq_cst);
    stateCount++;
    controllerPid(control, setpoint, sensors, state, stabilizerStep);
}

static void on_heartbeat(P2PPacket *packet) {
    if (packet->size != MJXBALL_BEAT_SIZE) return;
    memcpy(beat, packet->data, MJXBALL_BEAT_SIZE);
    atomic_signal_fence(memory_order_seq_cst);
    beatCount++;
}

static void send(const mjxball_setpoint *wanted) {
    static bool active = false;
    setpoint_t setpoint;
    memset(&setpoint, 0, sizeof setpoint);
    if (wanted->active) {
        setpoint.mode.roll = modeAbs;
        setpoint.mode.pitch = modeAbs;
        setpoint.mode.yaw = modeVelocity;
        setpoint.attitude.roll = wanted->roll;
        setpoint.attitude.pitch = wanted->pitch;
        setpoint.thrust = wanted->thrust;
        commanderSetSetpoint(&setpoint, COMMANDER_PRIORITY_EXTRX);
    } else if (active) {
        commanderRelaxPriority();
    }
    active = wanted->active;
    thrust = wanted->thrust;
}

static void receive(uint32_t now) {
    static uint32_t beats;
    uint8_t data[APPCHANNEL_MTU], reply[MJXBALL_REPLY_SIZE], word[MJXBALL_BEAT_SIZE];
    size_t size;
    while ((size = appchannelReceiveDataPacket(data, sizeof data, 0)) > 0) {
        int answer = mjxball_laptop(&core, data, (int)size, now, MEMORY, reply);
        if (answer) appchannelSendDataPacket(reply, (size_t)answer);
    }
    if (beats == beatCount) return;
    beats = copy_consistent(word, beat, sizeof word, &beatCount);
    mjxball_hear(&core, word, sizeof word, now);
}

static void print_changes(void) {
    static uint8_t phase, refusal;
    const uint8_t refused = core.order == MJXBALL_SPIN ? core.refusal : MJXBALL_GOOD; /* only if a start is requested */
    if (refused != refusal && refused) DEBUG_PRINT("refused: %s\n", mjxball_text(refused));
    if (core.phase != phase) DEBUG_PRINT("phase %d: %s\n", core.phase, mjxball_text(core.cause));
    refusal = refused;
    phase = core.phase;
}

void appMain(void) {
    const logVarId_t variances[3] = {
        logGetVarId("kalman", "varX"), logGetVarId("kalman", "varY"), logGetVarId("kalman", "varZ")};
    const logVarId_t voltage = logGetVarId("pm", "vbat");
    TickType_t wake = xTaskGetTickCount();
    period = (uint8_t)mjxball_period();
    mjxball_defaults(&set);
    mjxball_start(&core, T2M(wake));
    p2pRegisterCB(on_heartbeat);
    for (uint32_t tick = 0;; tick++) {
        uint64_t begun;
        uint32_t now;
        mjxball_state state;
        mjxball_setpoint wanted;
        mjxball_parameters asked;
        vTaskDelayUntil(&wake, M2T(mjxball_period()));
        begun = usecTimestamp();
        copy_consistent(&state, &newest, sizeof state, &stateCount);
        asked = set; /* one copy a period, since another task writes it */
        atomic_signal_fence(memory_order_seq_cst);
        now = T2M(xTaskGetTickCount()); /* after the copy, so that it is not before the state's time */
        receive(now);
        for (int i = 0; i < 3; i++) state.variance[i] = logGetFloat(variances[i]);
        state.voltage = logGetFloat(voltage);
        state.can_fly = supervisorCanFly();
        mjxball_tick(&core, &asked, &state, now, &wanted);
        send(&wanted);
        print_changes();
        if (tick % BEAT_TICKS == 0) {
            P2PPacket packet;
            memset(&packet, 0, sizeof packet);
            packet.size = MJXBALL_BEAT_SIZE;
            mjxball_send(&core, packet.data);
            radiolinkSendP2PPacketBroadcast(&packet);
        }
        ident = mjxball_ident(&core);
        laptopAge = now - core.laptop_time;
        peerAge = now - core.peer_time;
        used = (uint32_t)(usecTimestamp() - begun);
    }
}

PARAM_GROUP_START(mjxb)
PARAM_ADD(PARAM_FLOAT, goalX, &set.goal[0])   /* of O from its start [m] */
PARAM_ADD(PARAM_FLOAT, goalY, &set.goal[1])
PARAM_ADD(PARAM_FLOAT, goalZ, &set.goal[2])
PARAM_ADD(PARAM_FLOAT, mountX, &set.mount[0]) /* of this drone from O, body axes [m] */
PARAM_ADD(PARAM_FLOAT, mountY, &set.mount[1])
PARAM_ADD(PARAM_FLOAT, mountZ, &set.mount[2])
PARAM_ADD(PARAM_UINT8, curve, &set.curve)     /* of the firmware: 0 linear, 1 older */
PARAM_ADD(PARAM_FLOAT, battery, &set.battery) /* land below it [V] */
PARAM_ADD(PARAM_UINT32 | PARAM_RONLY, ident, &ident)   /* CRC of the weights in use */
PARAM_ADD(PARAM_UINT8 | PARAM_RONLY, role, &role)      /* 0 leader, 1 follower */
PARAM_ADD(PARAM_UINT8 | PARAM_RONLY, period, &period)  /* of the controller [ms] */
PARAM_GROUP_STOP(mjxb)

LOG_GROUP_START(mjxb)
LOG_ADD(LOG_UINT8, phase, &core.phase)        /* see core.h */
LOG_ADD(LOG_UINT8, cause, &core.cause)        /* of the phase */
LOG_ADD(LOG_UINT8, refusal, &core.refusal)    /* why it does not start */
LOG_ADD(LOG_UINT8, copying, &core.copying)    /* 1: the fallback controller flies */
LOG_ADD(LOG_FLOAT, late, &core.late)          /* recent late ticks */
LOG_ADD(LOG_UINT32, used, &used)              /* computing time of a tick [us] */
LOG_ADD(LOG_UINT32, laptopAge, &laptopAge)    /* since the laptop's last request [ms] */
LOG_ADD(LOG_UINT32, peerAge, &peerAge)        /* since the other drone's last heartbeat [ms] */
LOG_ADD(LOG_FLOAT, roll, &core.command[0])    /* commanded [rad] */
LOG_ADD(LOG_FLOAT, pitch, &core.command[1])
LOG_ADD(LOG_FLOAT, az, &core.command[2])      /* [m/s2] */
LOG_ADD(LOG_FLOAT, thrust, &thrust)           /* sent [thrust units] */
LOG_GROUP_STOP(mjxb)
