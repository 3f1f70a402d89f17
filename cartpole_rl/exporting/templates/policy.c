/* See policy.h. */
#include "policy.h"

#if POLICY_ID != 0x@@id@@u
#error "policy.h is of another export than policy.c: copy both files of one export"
#endif

#include <math.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "compile without -Ofast, -ffast-math and -ffinite-math-only: they remove the checks for finite numbers"
#endif

static const int16_t MOTORS[POLICY_ACTIONS] = {@@motors@@};
static const int16_t INWARD_FROM_LEFT = @@rightmost@@;
static const int16_t INWARD_FROM_RIGHT = @@leftmost@@;
static const float ANGLE_LIMIT = @@angle_limit@@; /* rad, of the pole from upright */

@@tables@@

@@helpers@@/* Set the measured state and the observation from the first counts of an episode; return the direction of the
 * track guard's motor value, 0 if it does not act. */
static int64_t perceive_first(policy_t *policy, const int32_t counts[2], float observation[POLICY_INPUTS])
{
@@first@@
}

/* The same from later counts. */
static int64_t perceive(policy_t *policy, const int32_t counts[2], float dt, float observation[POLICY_INPUTS])
{
@@later@@
}

static bool all_finite(const float *numbers, int count)
{
    for (int i = 0; i < count; i++) {
        if (!isfinite(numbers[i])) {
            return false;
        }
    }
    return true;
}

@@layers@@
int policy_action(const float observation[POLICY_INPUTS])
{
@@network@@
    if (!all_finite(observation, POLICY_INPUTS) || !all_finite(values, POLICY_ACTIONS)) {
        return POLICY_NO_ACTION;
    }
    int best = 0;
    for (int action = 1; action < POLICY_ACTIONS; action++) {
        best = values[action] > values[best] ? action : best;
    }
    return best;
}

void policy_start(policy_t *policy, float track_end, float pole_length)
{
    const bool length_fits = !POLICY_OBSERVES_LENGTH || (pole_length > 0.0f && pole_length <= POLICY_LONGEST_POLE);
    const bool ready = isfinite(track_end) && track_end > 0.0f && length_fits;
    *policy = (policy_t){.track_end = track_end, .pole_length = pole_length, .ready = ready};
}

void policy_resume(policy_t *policy)
{
    const bool ready = policy->ready;
    policy_start(policy, policy->track_end, policy->pole_length);
    policy->ready = ready;
}

void policy_drove(policy_t *policy, int16_t motor)
{
    policy->motor = motor;
}

int16_t policy_motor(policy_t *policy, int32_t cart_counts, int32_t pole_counts, float dt)
{
    const int32_t counts[2] = {cart_counts, pole_counts};
    float observation[POLICY_INPUTS];
    int64_t side = 0;
    int action = POLICY_NO_ACTION;

    if (policy->ready && !policy->started) {
        side = perceive_first(policy, counts, observation);
        action = policy_action(observation);
    } else if (policy->ready && isfinite(dt) && dt > 0.0f) {
        side = perceive(policy, counts, dt, observation);
        action = policy_action(observation);
    }
    policy->counts[0] = cart_counts;
    policy->counts[1] = pole_counts;
    policy->started = true;
    policy->ready = action != POLICY_NO_ACTION && fabsf(policy->state[2]) <= ANGLE_LIMIT;
    if (!policy->ready) {
        policy->motor = 0;
    } else if (side == 0) {
        policy->motor = MOTORS[action];
    } else {
        policy->motor = side > 0 ? INWARD_FROM_LEFT : INWARD_FROM_RIGHT;
    }
    return policy->motor;
}
