/* A policy that shuttles about the middle of the track, with the functions of an exported agent. */
#ifndef POLICY_H
#define POLICY_H

#include <stdint.h>

#define POLICY_ID 0x00000005u
#define POLICY_PERIOD_US 20000
#define POLICY_CART_NANOMETRES_PER_COUNT 22749
#define POLICY_POLE_COUNTS_PER_TURN 4096
#define POLICY_OBSERVES_LENGTH 0

typedef struct {
    float track_end; /* m from the middle to the soft limit */
} policy_t;

void policy_start(policy_t *policy, float track_end, float pole_length);
void policy_resume(policy_t *policy);
void policy_drove(policy_t *policy, int16_t motor);
int16_t policy_motor(policy_t *policy, int32_t cart_counts, int32_t pole_counts, float dt);

#endif
