#include "cart_window.h"

#include "cart_numbers.h"

void cart_window_reset(cart_window *window, uint32_t length_us)
{
    window->length_us = length_us;
    window->shortest_us = UINT32_MAX;
    window->first = window->used = 0;
    window->full = false;
}

static int32_t count_at(const cart_window *window, uint32_t number)
{
    return window->counts[(window->first + number) % CART_WINDOW_COUNTS];
}

void cart_window_add(cart_window *window, int32_t count, uint32_t period_us)
{
    if (period_us < window->shortest_us)
        window->shortest_us = period_us;
    /* so many of the shortest periods, and so any periods, last at least `length_us` */
    uint32_t length = (window->length_us + window->shortest_us - 1) / window->shortest_us + 1;
    if (length > CART_WINDOW_COUNTS)
        length = CART_WINDOW_COUNTS;
    if (window->used == CART_WINDOW_COUNTS) {
        window->first = (uint16_t)((window->first + 1u) % CART_WINDOW_COUNTS);
        window->used--;
    }
    window->counts[(window->first + window->used) % CART_WINDOW_COUNTS] = count;
    window->used++;
    window->full = window->used >= length;
    if (window->used > length) {
        uint32_t surplus = window->used - length;
        window->first = (uint16_t)((window->first + surplus) % CART_WINDOW_COUNTS);
        window->used = (uint16_t)length;
    }
}

static void extremes(const cart_window *window, int32_t *lowest, int32_t *highest)
{
    *lowest = *highest = count_at(window, 0);
    for (uint32_t number = 1; number < window->used; number++) {
        int32_t count = count_at(window, number);
        *lowest = count < *lowest ? count : *lowest;
        *highest = count > *highest ? count : *highest;
    }
}

int64_t cart_window_spread(const cart_window *window)
{
    int32_t lowest, highest;
    if (!window->full)
        return INT64_MAX;
    extremes(window, &lowest, &highest);
    return (int64_t)highest - lowest;
}

int32_t cart_window_centre(const cart_window *window)
{
    int32_t lowest, highest;
    extremes(window, &lowest, &highest);
    int64_t sum = (int64_t)lowest + highest;
    int64_t down = cart_floor_divide(sum, 2);
    return (int32_t)(down + (sum % 2 != 0 && down % 2 != 0));
}
