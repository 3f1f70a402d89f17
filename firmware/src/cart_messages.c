#include "cart_messages.h"

#include "cart_config.h"

int cart_host_payload(uint8_t type)
{
    switch (type) {
    case CART_HELLO:
    case CART_START:
    case CART_STOP:
    case CART_HOME:
    case CART_CLEAR_FAULT:
    case CART_START_POLICY:
        return 0;
    case CART_SET_MOTOR:
        return 6;
    case CART_SET_PERIOD:
        return 4;
    default:
        return -1;
    }
}

static uint8_t *put_u8(uint8_t *at, uint8_t number)
{
    *at = number;
    return at + 1;
}

static uint8_t *put_u16(uint8_t *at, uint16_t number)
{
    return put_u8(put_u8(at, (uint8_t)(number & 0xFF)), (uint8_t)(number >> 8));
}

static uint8_t *put_u32(uint8_t *at, uint32_t number)
{
    return put_u16(put_u16(at, (uint16_t)(number & 0xFFFF)), (uint16_t)(number >> 16));
}

size_t cart_pack_info(const cart_info *info, uint8_t *payload)
{
    uint8_t *at = payload;
    at = put_u8(at, CART_FIRMWARE_MAJOR);
    at = put_u8(at, CART_FIRMWARE_MINOR);
    at = put_u8(at, CART_FIRMWARE_PATCH);
    at = put_u16(at, CART_POLE_COUNTS);
    at = put_u32(at, CART_NANOMETRES);
    at = put_u16(at, CART_LARGEST_MOTOR);
    at = put_u32(at, (uint32_t)info->soft_limit);
    at = put_u32(at, (uint32_t)info->hard_limit);
    at = put_u32(at, info->period_us);
    at = put_u32(at, info->policy);
    return (size_t)(at - payload);
}

size_t cart_pack_state(const cart_state *state, uint8_t *payload)
{
    uint8_t *at = payload;
    at = put_u32(at, state->tick);
    at = put_u32(at, state->time_us);
    at = put_u32(at, (uint32_t)state->cart_counts);
    at = put_u32(at, (uint32_t)state->pole_counts);
    at = put_u16(at, (uint16_t)state->motor);
    at = put_u8(at, state->last_sequence);
    at = put_u16(at, state->fault);
    at = put_u16(at, state->command_age_ms);
    return (size_t)(at - payload);
}

size_t cart_pack_fault(uint16_t fault, uint32_t tick, uint8_t *payload)
{
    return (size_t)(put_u32(put_u16(payload, fault), tick) - payload);
}

int16_t cart_read_i16(const uint8_t *bytes)
{
    int32_t number = bytes[0] | (bytes[1] << 8);
    return (int16_t)(number > INT16_MAX ? number - 0x10000 : number);
}

uint32_t cart_read_u32(const uint8_t *bytes)
{
    return bytes[0] | ((uint32_t)bytes[1] << 8) | ((uint32_t)bytes[2] << 16) | ((uint32_t)bytes[3] << 24);
}
