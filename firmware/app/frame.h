/* Frames of the wire: COBS(bytes, CRC-16 of them), then one byte 0. The caller owns every byte. */
#ifndef FRAME_H
#define FRAME_H

#include <stdint.h>

#define FRAME_LONGEST 64u /* bytes with their CRC: COBS then adds one byte and the 0 */

/* CRC-16/CCITT-FALSE (polynomial 0x1021, start 0xFFFF) of n bytes, going on from crc. */
uint16_t frame_crc(uint16_t crc, const uint8_t *bytes, uint8_t n);

/* n bytes, room for two more behind them, into a frame with its 0; n + 4 bytes of it.
 * Gives how many, 0 where n + 2 is beyond FRAME_LONGEST. */
uint8_t frame_encode(uint8_t *bytes, uint8_t n, uint8_t *frame);

/* The n bytes of a frame ahead of its 0, in place. Gives how many remain without the CRC; 0 for
 * what is no whole frame. */
uint8_t frame_decode(uint8_t *frame, uint8_t n);

#endif
