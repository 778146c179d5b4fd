/* Frames of the wire: COBS(bytes, CRC-16 of them), then one byte 0. The caller owns every byte. */
#ifndef FRAME_H
#define FRAME_H

#include <stdint.h>

#define FRAME_LONGEST 64u /* bytes with their CRC: COBS then adds one byte and the 0 */

/* CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF) of n bytes, continued from crc. */
uint16_t frame_crc(uint16_t crc, const uint8_t *bytes, uint8_t n);

/* Encode n bytes, with space for two more after them, into a frame with its 0 of up to n + 4 bytes.
 * Returns its length, or 0 if n + 2 exceeds FRAME_LONGEST. */
uint8_t frame_encode(uint8_t *bytes, uint8_t n, uint8_t *frame);

/* Decode the n bytes of a frame before its 0, in place. Returns their number without the CRC, or 0
 * for a damaged frame. */
uint8_t frame_decode(uint8_t *frame, uint8_t n);

#endif
