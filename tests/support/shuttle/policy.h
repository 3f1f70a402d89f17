/* A policy that shuttles about the middle of the track, with the functions of an exported agent. */
#ifndef POLICY_H
#define POLICY_H

#include <stdint.h>

typedef struct {
    float track_end; /* m from the middle to the soft limit */
} policy_t;

void policy_start(policy_t *policy, float track_end, float pole_length);
int16_t policy_motor(policy_t *policy, int32_t cart_counts, int32_t pole_counts, float dt);

#endif
