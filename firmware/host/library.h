/* What the shared library of the emulated cart exports beside cart.h. */
#ifndef CART_LIBRARY_H
#define CART_LIBRARY_H

#include "cart.h"

#define CART_SNAPSHOT_NUMBERS 99

/* The size in bytes of the memory of the policy with which the library was compiled; 0 without one. */
size_t cart_policy_size(void);

/* Give a cart that has just booted this policy, if any, and its memory, all zeros. The pole's length in m is twice
   the distance from pivot to centre of mass. */
void cart_attach_policy(cart *self, void *memory, float length);

/* The size of a `cart` in bytes. */
size_t cart_size(void);

/* Let the SET_MOTOR that was just carried out come into force at `due_us` or later: an emulated latency. */
void cart_delay_command(cart *self, uint64_t due_us);

/* Split bytes of a stream; write each complete run after its length, at most 2 * count + 65 bytes, and return
   how many bytes were written. */
size_t cart_runs(cart_splitter *splitter, const uint8_t *bytes, size_t count, uint8_t *runs);

/* Write the whole state as CART_SNAPSHOT_NUMBERS numbers. */
void cart_snapshot(const cart *self, int64_t *numbers);

#endif
