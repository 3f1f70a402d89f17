/* The newest counts of one encoder, over a fixed time. */
#ifndef CART_WINDOW_H
#define CART_WINDOW_H

#include "cart_config.h"

#include <stdbool.h>
#include <stdint.h>

#define CART_LONGEST_WINDOW_US 2000000u
#define CART_SHORTEST_LOOK_US 15000u /* between two counts; with shorter periods, as many as reach it */
#define CART_WINDOW_COUNTS (CART_LONGEST_WINDOW_US / CART_SHORTEST_LOOK_US + 1)

typedef struct {
    uint32_t length_us;
    uint32_t shortest_us; /* period so far */
    uint16_t first; /* index of the oldest count */
    uint16_t used;
    bool full; /* the counts cover `length_us` */
    int32_t counts[CART_WINDOW_COUNTS];
} cart_window;

void cart_window_reset(cart_window *window, uint32_t length_us);

/* Add a count, `period_us` after the last one. A window never holds more than CART_WINDOW_COUNTS. */
void cart_window_add(cart_window *window, int32_t count, uint32_t period_us);

/* Largest less smallest count; INT64_MAX until the window is full. */
int64_t cart_window_spread(const cart_window *window);

/* Middle between the largest and the smallest count; a half is rounded to the even count. */
int32_t cart_window_centre(const cart_window *window);

#endif
