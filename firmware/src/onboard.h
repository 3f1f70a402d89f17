/* Attaches an agent that cartpole-export format=c wrote (policy.h, policy.c) to a cart, as its policy. */
#ifndef ONBOARD_H
#define ONBOARD_H

#include "cart.h"
#include "policy.h"

#if POLICY_CART_NANOMETRES_PER_COUNT != CART_NANOMETRES || POLICY_POLE_COUNTS_PER_TURN != CART_POLE_COUNTS
#error "policy.h is for other encoders than cart_rig.h: export the agent for this cart"
#endif

#ifndef CART_POLE_LENGTH
#if POLICY_OBSERVES_LENGTH
#error "this agent observes the length of the pole: compile with -DCART_POLE_LENGTH=0.3556f (make: POLE_LENGTH=0.3556): m, twice the distance from pivot to centre of mass"
#endif
#define CART_POLE_LENGTH 0.0f /* not read */
#endif

/* The memory of the agent on one cart. */
typedef struct {
    policy_t policy;
    float pole_length; /* m */
} onboard_memory;

static inline int16_t onboard_motor(void *memory, const cart_observation *observation)
{
    onboard_memory *agent = (onboard_memory *)memory;
    policy_t *policy = &agent->policy;
    if (observation->set_period_us != POLICY_PERIOD_US)
        return 0; /* it was trained for another period */
    if (observation->first)
        policy_start(policy, (float)(observation->soft_limit * CART_METRES), agent->pole_length);
    else if (observation->resumed)
        policy_resume(policy);
    else
        policy_drove(policy, observation->motor);
    return policy_motor(policy, observation->cart_counts, observation->pole_counts,
                        (float)observation->period_us / 1e6f);
}

/* The identity for INFO: a board that was compiled for another length of the pole has another one. */
static inline uint32_t onboard_identity(float pole_length)
{
    uint32_t centimetres = POLICY_OBSERVES_LENGTH ? (uint32_t)(100.0 * (double)pole_length + 0.5) : 0u;
    uint32_t identity = POLICY_ID ^ (centimetres * 0x9E3779B1u);
    return identity ? identity : 1u;
}

/* Call after the boot of the cart. `agent` has to outlive it. */
static inline void onboard_attach_memory(cart *self, onboard_memory *agent, float pole_length)
{
    agent->pole_length = pole_length;
    self->policy = onboard_motor;
    self->policy_identity = onboard_identity(pole_length);
    self->policy_memory = agent;
}

/* The same for the only cart of a program. */
static inline void onboard_attach(cart *self)
{
    static onboard_memory agent;
    onboard_attach_memory(self, &agent, CART_POLE_LENGTH);
}

#endif
