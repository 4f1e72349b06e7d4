"""Exceptions in one line: of other people's code, whose stack says less than where it failed."""


def of(error: BaseException) -> str:
    """What an exception is, what it says, and the last line outside of this package that it came through."""
    said = (str(error).strip() or " ").splitlines()[0].strip()[:200]
    where, trace = "", error.__traceback__
    while trace is not None:
        frame = trace.tb_frame
        name, file = str(frame.f_globals.get("__name__")), frame.f_code.co_filename
        if name.partition(".")[0] not in ("vecpsmbpo", "importlib") and not file.startswith("<"):
            where = f" at {file}:{trace.tb_lineno}"
        trace = trace.tb_next
    return f"{type(error).__name__}{f': {said}' if said else ''}{where}"
