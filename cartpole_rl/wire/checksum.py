"""CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected, no final xor; "123456789" is 0x29B1."""

import binascii

CRC_START = 0xFFFF


def crc16(data: bytes) -> int:
    """Return the checksum of `data`. Source: CRC-16/IBM-3740 in the CRC catalogue, alias CCITT-FALSE."""
    return binascii.crc_hqx(data, CRC_START)
