/* What `glue.c` uses of the Crazyflie firmware's public interface, release 2026.08: names, types and order of arguments,
 * so that an app can be compiled without the firmware. Written from facts; it links with nothing. */
#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef uint32_t TickType_t, stabilizerStep_t;
#define M2T(milliseconds) ((TickType_t)(milliseconds))
#define T2M(ticks) ((unsigned int)(ticks))
TickType_t xTaskGetTickCount(void);
void vTaskDelayUntil(TickType_t *wake, TickType_t ticks);
uint64_t usecTimestamp(void);
int consolePrintf(const char *format, ...) __attribute__((format(printf, 1, 2)));
#define DEBUG_PRINT(format, ...) consolePrintf(DEBUG_MODULE ": " format, ##__VA_ARGS__)

struct vec3_s {
    uint32_t timestamp;
    float x, y, z;
};
typedef struct vec3_s point_t, velocity_t, acc_t, jerk_t;
typedef struct {
    float x, y, z, w;
} quaternion_t;
typedef struct {
    uint32_t timestamp;
    float roll, pitch, yaw;
} attitude_t;
typedef union {
    struct {
        float x, y, z;
    };
    float axis[3];
} Axis3f;
typedef struct {
    Axis3f acc, gyro, mag;
} sensorData_t;
typedef struct {
    attitude_t attitude;
    quaternion_t attitudeQuaternion;
    point_t position;
    velocity_t velocity;
    acc_t acc;
} state_t;
typedef struct {
    int16_t roll, pitch, yaw;
    float thrust;
} control_t;
typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
    uint32_t timestamp;
    attitude_t attitude, attitudeRate;
    quaternion_t attitudeQuaternion;
    float thrust;
    point_t position;
    velocity_t velocity;
    acc_t acceleration;
    jerk_t jerk;
    bool velocity_body;
    struct {
        stab_mode_t x, y, z, roll, pitch, yaw, quat;
    } mode;
} setpoint_t;

#define COMMANDER_PRIORITY_EXTRX 3
void commanderSetSetpoint(setpoint_t *setpoint, int priority);
void commanderRelaxPriority(void);
bool supervisorCanFly(void);

void controllerPidInit(void);
bool controllerPidTest(void);
void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
    const stabilizerStep_t stabilizerStep);
void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
    const state_t *state, const stabilizerStep_t stabilizerStep);
void appMain(void);

#define APPCHANNEL_MTU 30
int appchannelSendDataPacket(void *data, size_t length);
size_t appchannelReceiveDataPacket(void *buffer, size_t max_length, int timeout_ms);

#define P2P_MAX_DATA_SIZE 60
typedef struct {
    uint8_t size, rssi, port, data[P2P_MAX_DATA_SIZE];
} __attribute__((packed)) P2PPacket;
void p2pRegisterCB(void (*callback)(P2PPacket *));
bool radiolinkSendP2PPacketBroadcast(P2PPacket *packet);

typedef uint16_t logVarId_t;
logVarId_t logGetVarId(const char *group, const char *name);
float logGetFloat(logVarId_t variable);

/* A table of names, types and addresses. */
struct entry {
    uint8_t type;
    const char *name;
    void *address;
};
#define PARAM_UINT8 0x08
#define PARAM_UINT32 0x0A
#define PARAM_FLOAT 0x06
#define PARAM_RONLY 0x40
#define LOG_UINT8 1
#define LOG_UINT32 3
#define LOG_FLOAT 7
#define PARAM_GROUP_START(name) const struct entry params_of_##name[] = {
#define PARAM_ADD(type, name, address) {type, #name, address},
#define PARAM_GROUP_STOP(name) {0, 0, 0}};
#define LOG_GROUP_START(name) const struct entry logs_of_##name[] = {
#define LOG_ADD(type, name, address) {type, #name, address},
#define LOG_GROUP_STOP(name) {0, 0, 0}};
