/* Integer arithmetic that C leaves to the reader: floors, sizes of differences, wrapping subtraction. */
#ifndef CART_NUMBERS_H
#define CART_NUMBERS_H

#include <stdint.h>

/* The quotient rounded towards minus infinity; the divisor is positive. */
static inline int64_t cart_floor_divide(int64_t number, int64_t divisor)
{
    int64_t quotient = number / divisor;
    return (number % divisor < 0) ? quotient - 1 : quotient;
}

/* The middle between two counts, rounded down. */
static inline int32_t cart_middle(int32_t one, int32_t other)
{
    return (int32_t)cart_floor_divide((int64_t)one + other, 2);
}

/* The size of the difference of two counts. */
static inline int64_t cart_distance(int32_t one, int32_t other)
{
    int64_t difference = (int64_t)one - other;
    return difference < 0 ? -difference : difference;
}

/* The difference of two counts; it wraps at 2^31 as an encoder's counter does. */
static inline int32_t cart_subtract(int32_t count, int32_t zero)
{
    uint32_t difference = (uint32_t)count - (uint32_t)zero;
    return difference <= INT32_MAX ? (int32_t)difference : -(int32_t)(UINT32_MAX - difference) - 1;
}

#endif
