/* Frames: COBS of (version, type, sequence, flags, payload, CRC-16 little-endian), then 0x00. */
#ifndef CART_FRAMES_H
#define CART_FRAMES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define CART_VERSION 2
#define CART_HEADER_BYTES 4
#define CART_CRC_BYTES 2
#define CART_LONGEST_RUN 64 /* stuffed bytes of a frame without its final 0x00 */
#define CART_LONGEST_PAYLOAD 27
#define CART_FRAME_BYTES (CART_HEADER_BYTES + CART_LONGEST_PAYLOAD + CART_CRC_BYTES + 2)

/* A frame with a right checksum whose version, type and payload are not checked yet. */
typedef struct {
    uint8_t version;
    uint8_t type;
    uint8_t sequence;
    uint8_t flags;
    uint8_t payload[CART_LONGEST_RUN];
    size_t payload_length;
} cart_envelope;

/* Collects the bytes of a stream up to each 0x00. */
typedef struct {
    uint8_t run[CART_LONGEST_RUN]; /* stuffed bytes since the last 0x00 */
    size_t length;
    bool dropping; /* the run is too long; it is dropped up to its 0x00 */
} cart_splitter;

/* CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF; "123456789" gives 0x29B1. */
uint16_t cart_crc16(const uint8_t *data, size_t length);

/* Write the stuffed bytes of up to 254 bytes; return their number, length + 1. */
size_t cart_cobs_encode(const uint8_t *data, size_t length, uint8_t *stuffed);

/* Write the decoded bytes, fewer than `length`; return false if a block is cut short or holds a zero. */
bool cart_cobs_decode(const uint8_t *stuffed, size_t length, uint8_t *data, size_t *decoded);

/* Write a frame with its final 0x00, at most CART_FRAME_BYTES; return its length. */
size_t cart_frame(uint8_t type, uint8_t sequence, uint8_t flags, const uint8_t *payload, size_t length,
                  uint8_t *frame);

/* Open a run of at most CART_LONGEST_RUN stuffed bytes; return false for a damaged frame. */
bool cart_open(const uint8_t *stuffed, size_t length, cart_envelope *envelope);

/* Take one byte; return true if it completes a run, which is valid until the next byte. */
bool cart_split(cart_splitter *splitter, uint8_t byte, size_t *length);

#endif
