/* Takes: bytes. Gives: frames, and the bytes of valid frames. */
#include "frame.h"

uint16_t frame_crc(uint16_t crc, const uint8_t *bytes, uint8_t n)
{
    uint8_t k;
    for (k = 0; k < n; ++k) {
        /* A byte at a time without a table: the polynomial x^16 + x^12 + x^5 + 1 is sparse. */
        uint8_t x = (uint8_t)((uint8_t)(crc >> 8) ^ bytes[k]);
        x = (uint8_t)(x ^ (x >> 4));
        crc = (uint16_t)((crc << 8) ^ ((uint16_t)x << 12) ^ ((uint16_t)x << 5) ^ x);
    }
    return crc;
}

uint8_t frame_encode(uint8_t *bytes, uint8_t n, uint8_t *frame)
{
    const uint16_t crc = frame_crc(0xffffu, bytes, n);
    uint8_t code_at = 0, put = 1, k;
    if (n > FRAME_LONGEST - 2u) {
        return 0;
    }
    bytes[n] = (uint8_t)(crc & 0xffu);
    bytes[n + 1] = (uint8_t)(crc >> 8);
    for (k = 0; k < n + 2; ++k) {
        if (bytes[k] == 0) {
            frame[code_at] = (uint8_t)(put - code_at);
            code_at = put++;
        } else {
            frame[put++] = bytes[k];
        }
    }
    frame[code_at] = (uint8_t)(put - code_at);
    frame[put++] = 0;
    return put;
}

uint8_t frame_decode(uint8_t *frame, uint8_t n)
{
    uint8_t taken = 0, put = 0;
    if (n > FRAME_LONGEST + 1u) {
        return 0;
    }
    while (taken < n) {
        const uint8_t code = frame[taken++];
        uint8_t k;
        if (code == 0 || code - 1 > n - taken) {
            return 0;
        }
        for (k = 1; k < code; ++k) {
            if (frame[taken] == 0) {
                return 0;
            }
            frame[put++] = frame[taken++];
        }
        if (taken < n) {
            frame[put++] = 0;
        }
    }
    if (put < 3 || frame_crc(0xffffu, frame, (uint8_t)(put - 2)) !=
                       (uint16_t)(frame[put - 2] | (uint16_t)(frame[put - 1] << 8))) {
        return 0;
    }
    return (uint8_t)(put - 2);
}
