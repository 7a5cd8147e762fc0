"""``python -m xtdrone_interaction COMMAND``: what ``./xtdrone`` starts. Ctrl-C is quiet from the first moment on.

What a machine is short of is told in one line, also where it already keeps a library from being loaded.
"""

import signal
import sys

if __name__ == "__main__":  # worker processes import this file, too
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # while modules are loaded there is nothing to clean up
    from xtdrone_interaction.hints import advice

    try:
        words = sys.argv[1:]
        if words[:1] == ["launch"]:  # it does without most of what the others load
            words = words[1:]
            from xtdrone_interaction.launch_cli import main
        else:
            from xtdrone_interaction.cli import main

        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.exit(main(words))
    except KeyboardInterrupt:  # before or after the time in which a command takes signals itself
        print("xtdrone: stopped by SIGINT", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    except Exception as error:
        causes: list[BaseException] = [error]
        while before := causes[-1].__cause__ or causes[-1].__context__:
            causes.append(before)
        reasons = advice(" ".join(map(repr, causes)))
        if not reasons:
            raise
        print(f"xtdrone: {type(error).__name__}: {reasons[0]}", file=sys.stderr)
        sys.exit(1)
