/* The policy of an agent of cartpole_rl in C99, written by cartpole-export format=c.
 *
 *     flash       @@flash@@ bytes of tables, and the code
 *     RAM         @@ram@@ bytes for each cart (policy_t), @@stack@@ bytes of buffers on the stack
 *     operations  @@operations@@ multiply-adds, @@roots@@ square roots and @@trigonometry@@ sines and cosines a period
 *
 * No heap, no writable static variables, fixed buffers. It needs a float unit or a soft-float library, and
 * <math.h>. -Ofast and -ffast-math are refused: they remove the checks for finite numbers.
 *
 * In each control period of @@period_ms@@ ms, read both encoders, call policy_motor() and set the returned motor
 * value at once. Call policy_start() before the first period of an episode, with the cart homed. Counts and
 * motor values are positive to the right; cart counts are 0 in the middle of the track, pole counts 0 at
 * upright. This code only chooses motor values: the limits, the watchdog and the faults of the firmware must
 * stay in force. Track guard of the training: @@guard@@
 *
 * Training: "@@origin@@"
 * SHA-256: @@checksum@@
 */
#ifndef POLICY_H
#define POLICY_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define POLICY_ID 0x@@id@@u /* policy.c is of the same export */
#define POLICY_INPUTS @@inputs@@
#define POLICY_ACTIONS @@actions@@
#define POLICY_NO_ACTION (-1)
#define POLICY_PERIOD_US @@period_us@@
#define POLICY_CART_NANOMETRES_PER_COUNT @@nanometres@@
#define POLICY_POLE_COUNTS_PER_TURN @@counts_per_turn@@
#define POLICY_TRACK_HALF_LENGTH @@track@@ /* m, of the nominal cart */
#define POLICY_OBSERVES_LENGTH @@observes_length@@ /* 1 if the agent reads pole_length */
#define POLICY_LONGEST_POLE 3.0f /* m */
#define POLICY_STARTS_UPRIGHT @@starts_upright@@ /* 1 if an episode must start with the pole upright */

/* The memory of one cart. Its fields are private. */
typedef struct {
    float track_end;     /* m from the middle */
    float pole_length;   /* m */
    float state[4];      /* x m, x_dot m/s, theta rad, theta_dot rad/s */
    float past[@@past@@];       /* the observation of earlier periods */
    int32_t counts[2];   /* of cart and pole, one period ago */
    int16_t motor;       /* of the last period */
    bool started;        /* counts are known */
    bool ready;          /* policy_start() succeeded, and every number since was finite */
} policy_t;

/* Start an episode. track_end: m from the middle to the soft limit, which the track guard reads; without a positive,
 * finite number every motor value is 0. pole_length: m, twice the distance from pivot to centre of mass;
 * @@length_use@@ */
void policy_start(policy_t *policy, float track_end, float pole_length);

/* Continue an episode after periods in which policy_motor() was not called: the next counts are then like the first
 * of an episode, without velocities and past. Once policy_motor() returns 0 for the rest of an episode, it still does. */
void policy_resume(policy_t *policy);

/* Say before policy_motor() which motor value has been in force since its last call, where that may not be the one
 * that it returned: a limit of the track replaces it. */
void policy_drove(policy_t *policy, int16_t motor);

/* Return the motor value, -255 to 255, for the newest counts. dt: s since the counts of the last call, by the
 * clock of the encoders; not read in the first call of an episode. Before policy_start(), once a number was not
 * finite or dt was not positive, and once the pole was beyond the angle limit of the task, it returns 0. */
int16_t policy_motor(policy_t *policy, int32_t cart_counts, int32_t pole_counts, float dt);

/* Return the index of the best motor value for an observation, or POLICY_NO_ACTION if a number is not finite. */
int policy_action(const float observation[POLICY_INPUTS]);

#ifdef __cplusplus
}
#endif

#endif
