#include "policy.h"

#define PUSH 110

void policy_start(policy_t *policy, float track_end, float pole_length)
{
    policy->track_end = pole_length > 0.0f ? track_end : 0.0f;
}

void policy_resume(policy_t *policy)
{
    (void)policy;
}

void policy_drove(policy_t *policy, int16_t motor)
{
    (void)policy;
    (void)motor;
}

int16_t policy_motor(policy_t *policy, int32_t cart_counts, int32_t pole_counts, float dt)
{
    if (policy->track_end < 0.3f || dt < 0.001f || pole_counts < 1500 || pole_counts > 2600)
        return 0;
    return cart_counts > 0 ? -PUSH : PUSH;
}
