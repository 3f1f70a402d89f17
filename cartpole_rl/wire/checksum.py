"""CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected, no final xor; "123456789" is 0x29B1."""

import binascii

CRC_START = 0xFFFF


def crc16(data: bytes) -> int:
    """Checksum of `data`, 0 to 65535. Source: the CRC catalogue's CRC-16/IBM-3740, alias CCITT-FALSE."""
    return binascii.crc_hqx(data, CRC_START)
