/* Attaches an agent that cartpole-export format=c wrote (policy.h, policy.c) to a cart, as its policy. */
#ifndef ONBOARD_H
#define ONBOARD_H

#include "cart.h"
#include "policy.h"

#ifndef CART_POLE_LENGTH
#define CART_POLE_LENGTH 0.3556f /* m, twice the distance from pivot to centre of mass; few agents read it */
#endif

static inline int16_t onboard_motor(void *memory, const cart_observation *observation)
{
    policy_t *policy = (policy_t *)memory;
    if (observation->first)
        policy_start(policy, (float)(observation->soft_limit * CART_METRES), CART_POLE_LENGTH);
    return policy_motor(policy, observation->cart_counts, observation->pole_counts,
                        (float)observation->period_us / 1e6f);
}

/* Call after the boot of the cart. */
static inline void onboard_attach(cart *self)
{
    static policy_t policy;
    self->policy = onboard_motor;
    self->policy_memory = &policy;
}

#endif
