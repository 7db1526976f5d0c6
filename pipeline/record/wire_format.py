"""The bytes of protobuf messages, field by field, as the library would write them: a message of some ten large arrays costs a join, where an object
of the library is filled and then read again."""

from __future__ import annotations

_VARINT, _LENGTH = 0, 2  # types of a field on the wire
_SHORT = [bytes((number,)) for number in range(0x80)]
_TAGS = [bytes((field << 3 | _LENGTH,)) for field in range(16)]  # of what a length stands before


def varint(number: int) -> bytes:
    """Seven bits a byte, the lowest first; a negative number as the one of 64 bits that has its bits."""
    if 0 <= number < 0x80:
        return _SHORT[number]
    if 0 < number < 0x4000:
        return bytes((number & 0x7F | 0x80, number >> 7))
    number &= (1 << 64) - 1
    digits = bytearray()
    while number > 0x7F:
        digits.append(number & 0x7F | 0x80)
        number >>= 7
    digits.append(number)
    return bytes(digits)


def number_field(field: int, number: int) -> bytes:
    """An int32, int64 or enum; nothing for 0."""
    return varint(field << 3 | _VARINT) + varint(number) if number else b""


def head(field: int, size: int) -> bytes:
    """What stands before the `size` bytes of a text, of bytes, of a message or of packed numbers, in one of the fields 1..15."""
    return _TAGS[field] + varint(size)


def bytes_field(field: int, content: bytes) -> bytes:
    """A text or bytes; nothing for empty ones."""
    return head(field, len(content)) + content if content else b""
