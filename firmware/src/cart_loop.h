/* The cart's main loop over a board's hardware.

   A board provides the functions below and calls cart_loop_boot once and cart_loop_poll again and again,
   at least once a millisecond. No function may block. */
#ifndef CART_LOOP_H
#define CART_LOOP_H

#include "cart.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Microseconds since any moment; wraps at 2^32. */
uint32_t cart_hardware_clock_us(void);

/* The count of an encoder since boot, positive to the right, 4 counts per line of the disc. */
int32_t cart_hardware_cart_count(void);
int32_t cart_hardware_pole_count(void);

#if CART_SWITCHES
/* The end switches that are pressed: CART_LEFT, CART_RIGHT or both. */
uint8_t cart_hardware_switches(void);
#endif

/* Put a motor value, -255 to 255, on the motor; 0 must leave it without power. */
void cart_hardware_set_motor(int16_t value);

/* The next byte from the host, or -1 if none has arrived. */
int cart_hardware_read(void);

/* Queue a whole frame for the host, or drop it if there is not enough room. */
void cart_hardware_write(const uint8_t *frame, size_t length);

typedef struct {
    cart core;
    cart_splitter splitter;
    uint32_t clock_us; /* of the last poll */
    uint64_t now_us;   /* since boot */
    uint64_t looked_us; /* at the cart's position */
    uint64_t end_us;   /* of the present period */
} cart_loop;

/* Boot the cart: motor 0, one 0x00 to the host, which ends any text of a boot loader. */
void cart_loop_boot(cart_loop *loop);

/* Handle at most 64 bytes from the host, and end the period if it is over. Return true if it ended. */
bool cart_loop_poll(cart_loop *loop);

#ifdef __cplusplus
}
#endif

#endif
