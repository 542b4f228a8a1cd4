"""Lines of numbers to rows of float64, at the speed at which a disk delivers them.

np.loadtxt takes 1 s for a million lines, several times as long, knows one comment mark and one separator,
and can't be asked what the broken line looks like.
"""

import numpy as np

from ...runtime.jit import inline_kernel, kernel

PARSED, NOT_A_NUMBER, TOO_FEW, TOO_MANY = 0, -1, -2, -3

TAB, NEWLINE, RETURN, SPACE, HASH, SLASH = 9, 10, 13, 32, 35, 47
PLUS, MINUS, DOT, ZERO = 43, 45, 46, 48
LOWER, LETTER_E, LETTER_N = 32, ord("e"), ord("n")
NAN, INF, INFINITY = (np.frombuffer(word, dtype=np.uint8) for word in (b"nan", b"inf", b"infinity"))

POWERS = 10.0 ** np.arange(309)
MAX_POWER = 308
FULL = 10**17  # a mantissa from here on takes no further digit: 18 digits are more than float64 holds


@inline_kernel
def skip_blanks(data, i):
    """Index of the first byte from `i` that is neither space nor tab."""
    while i < len(data) and (data[i] == SPACE or data[i] == TAB):
        i += 1
    return i


@inline_kernel
def is_line_end(data, i):
    """True at a newline, a return or the end of the file."""
    return i >= len(data) or data[i] == NEWLINE or data[i] == RETURN


@inline_kernel
def is_comment(data, i):
    """True where # or // begins."""
    return data[i] == HASH or (data[i] == SLASH and i + 1 < len(data) and data[i + 1] == SLASH)


@inline_kernel
def next_line(data, i):
    """Index of the first byte of the next line; its end may be LF, CR LF or CR."""
    while not is_line_end(data, i):
        i += 1
    if i + 1 < len(data) and data[i] == RETURN and data[i + 1] == NEWLINE:
        i += 1
    return i + 1


@inline_kernel
def parse_digits(data, i, mantissa):
    """The mantissa with the digits from `i` appended, how many found no room in it, and where they end."""
    num_left_out = 0
    while i < len(data) and ZERO <= data[i] <= ZERO + 9:
        if mantissa < FULL:
            mantissa = mantissa * 10 + (np.int64(data[i]) - ZERO)
        else:
            num_left_out += 1
        i += 1
    return mantissa, num_left_out, i


@inline_kernel
def has_word(data, i, word):
    """True if the lower-case `word` stands at `i`, in any case."""
    if i + len(word) > len(data):
        return False
    num_alike = 0
    for k in range(len(word)):
        num_alike += data[i + k] | LOWER == word[k]
    return num_alike == len(word)


@inline_kernel
def parse_word(data, i):
    """NaN or infinity and where the word ends; -1 if neither stands at `i`."""
    if has_word(data, i, NAN):
        return np.nan, i + 3
    if has_word(data, i, INFINITY):
        return np.inf, i + 8
    if has_word(data, i, INF):
        return np.inf, i + 3
    return 0.0, -1


@inline_kernel
def parse_exponent(data, i):
    """The power of ten written from `i`, just after the e, and where it ends; -1 if there is none."""
    is_negative = i < len(data) and data[i] == MINUS
    if i < len(data) and (data[i] == MINUS or data[i] == PLUS):
        i += 1
    power, _, end = parse_digits(data, i, 0)
    power = min(power, 9999)
    return (-power if is_negative else power), (end if end > i else -1)


@inline_kernel
def times_power(mantissa, power):
    """Mantissa x 10^power within a few roundings of the nearest float64; below 1e-290 it may be 0."""
    # No second division by a power: fastmath joins the two, and the joint divisor overflows.
    if power < -MAX_POWER or mantissa == 0.0:
        return 0.0
    if power < 0:
        return mantissa / POWERS[-power]
    return mantissa * POWERS[power] if power <= MAX_POWER else np.inf


@inline_kernel
def parse_number(data, i):
    """The number that begins at `i` and where it ends; -1 if none does."""
    is_negative = i < len(data) and data[i] == MINUS
    if i < len(data) and (data[i] == MINUS or data[i] == PLUS):
        i += 1
    mantissa, power, end = parse_digits(data, i, 0)
    num_digits = end - i
    if end < len(data) and data[end] == DOT:
        begin = end + 1
        mantissa, num_left_out, end = parse_digits(data, begin, mantissa)
        power += num_left_out - (end - begin)
        num_digits += end - begin
    if num_digits == 0:
        value, end = parse_word(data, i)
        return (-value if is_negative else value), end
    if end < len(data) and data[end] | LOWER == LETTER_E:
        shift, end = parse_exponent(data, end + 1)
        power += shift
    value = times_power(np.float64(mantissa), power)
    return (-value if is_negative else value), end


@inline_kernel
def skip_field(data, i, separator):
    """Index just behind the field that begins at `i`, whatever it holds."""
    while not is_line_end(data, i) and data[i] != separator and (separator != SPACE or data[i] != TAB):
        i += 1
    return i


@inline_kernel
def next_field(data, i, separator):
    """Where the next field begins, or the line ends, from `i` just behind a field; -1 if neither."""
    begin = skip_blanks(data, i)
    if is_line_end(data, begin):
        return begin
    if separator != SPACE:
        return skip_blanks(data, begin + 1) if data[begin] == separator else -1
    return begin if begin > i else -1


@inline_kernel
def parse_line(data, i, separator, targets, row):
    """Fill `row` from the line at `i`; where the next field or the line's end is, or a status below 0."""
    for k in range(len(targets)):
        if is_line_end(data, i):
            return TOO_FEW
        if targets[k] >= 0:
            row[targets[k]], i = parse_number(data, i)
        else:
            i = skip_field(data, i, separator)
        if i >= 0:
            i = next_field(data, i, separator)
        if i < 0:
            return NOT_A_NUMBER
    return i


@kernel
def parse_rows(data, start, separator, targets, is_exact, rows):
    """Fill `rows` (R, C) with numbers from the lines of text that begin at byte `start` of `data` (uint8).

    Field k of a line goes to column `targets[k]`, or nowhere if that is below 0. `separator` is a comma, a
    semicolon or a space; spaces and tabs around fields never count. Blank lines and lines that begin with #
    or // are passed over; with `is_exact` a line may hold no further field. Gives the number of rows filled,
    the number of lines read, the byte behind the last of them (or where the broken one begins), a status.
    """
    i, num_lines, num_rows = start, 0, 0
    while i < len(data) and num_rows < len(rows):
        begin = i
        num_lines += 1
        i = skip_blanks(data, i)
        if not is_line_end(data, i) and not is_comment(data, i):
            i = parse_line(data, i, separator, targets, rows[num_rows])
            if i < 0:
                return num_rows, num_lines, begin, i
            if is_exact and not is_line_end(data, i):
                return num_rows, num_lines, begin, TOO_MANY
            num_rows += 1
        i = next_line(data, i)
    return num_rows, num_lines, i, PARSED
