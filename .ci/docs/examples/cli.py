"""The command line."""

from jaxilc.cli import app, main

# %% app, main
print(sorted(one.callback.__name__ for one in app.registered_commands)[:3], callable(main))
# ['certify', 'demo', 'design'] True
