#include "cart_frames.h"

#include <string.h>

#define FULL_BLOCK 0xFF /* code byte of a block of 254 bytes that is not followed by a zero */

uint16_t cart_crc16(const uint8_t *data, size_t length)
{
    uint16_t crc = 0xFFFF;
    for (size_t at = 0; at < length; at++) {
        crc = (uint16_t)(crc ^ (data[at] << 8));
        for (int bit = 0; bit < 8; bit++)
            crc = (uint16_t)((crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1);
    }
    return crc;
}

size_t cart_cobs_encode(const uint8_t *data, size_t length, uint8_t *stuffed)
{
    size_t code = 0, written = 1;
    for (size_t at = 0; at < length; at++) {
        if (data[at] != 0) {
            stuffed[written++] = data[at];
            continue;
        }
        stuffed[code] = (uint8_t)(written - code);
        code = written++;
    }
    stuffed[code] = (uint8_t)(written - code);
    return written;
}

bool cart_cobs_decode(const uint8_t *stuffed, size_t length, uint8_t *data, size_t *decoded)
{
    size_t at = 0, written = 0;
    if (length == 0)
        return false;
    while (at < length) {
        uint8_t code = stuffed[at];
        if (code == 0 || code > length - at)
            return false;
        for (size_t next = at + 1; next < at + code; next++) {
            if (stuffed[next] == 0)
                return false;
            data[written++] = stuffed[next];
        }
        at += code;
        if (code != FULL_BLOCK && at < length)
            data[written++] = 0;
    }
    *decoded = written;
    return true;
}

size_t cart_frame(uint8_t type, uint8_t sequence, uint8_t flags, const uint8_t *payload, size_t length,
                  uint8_t *frame)
{
    uint8_t body[CART_HEADER_BYTES + CART_LONGEST_PAYLOAD + CART_CRC_BYTES];
    size_t end = CART_HEADER_BYTES + length;
    body[0] = CART_VERSION;
    body[1] = type;
    body[2] = sequence;
    body[3] = flags;
    memcpy(body + CART_HEADER_BYTES, payload, length);
    uint16_t crc = cart_crc16(body, end);
    body[end++] = (uint8_t)(crc & 0xFF);
    body[end++] = (uint8_t)(crc >> 8);
    size_t written = cart_cobs_encode(body, end, frame);
    frame[written++] = 0;
    return written;
}

bool cart_open(const uint8_t *stuffed, size_t length, cart_envelope *envelope)
{
    uint8_t data[CART_LONGEST_RUN];
    size_t decoded;
    if (length > CART_LONGEST_RUN || !cart_cobs_decode(stuffed, length, data, &decoded))
        return false;
    if (decoded < CART_HEADER_BYTES + CART_CRC_BYTES)
        return false;
    size_t end = decoded - CART_CRC_BYTES;
    if (cart_crc16(data, end) != (uint16_t)(data[end] | (data[end + 1] << 8)))
        return false;
    envelope->version = data[0];
    envelope->type = data[1];
    envelope->sequence = data[2];
    envelope->flags = data[3];
    envelope->payload_length = end - CART_HEADER_BYTES;
    memcpy(envelope->payload, data + CART_HEADER_BYTES, envelope->payload_length);
    return true;
}

bool cart_split(cart_splitter *splitter, uint8_t byte, size_t *length)
{
    if (byte == 0) {
        *length = splitter->length;
        splitter->length = 0;
        splitter->dropping = false;
        return *length > 0;
    }
    if (splitter->dropping)
        return false;
    if (splitter->length == CART_LONGEST_RUN) {
        splitter->length = 0;
        splitter->dropping = true;
        return false;
    }
    splitter->run[splitter->length++] = byte;
    return false;
}
