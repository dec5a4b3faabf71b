"""The systems that ship with Rampart, as data: one TOML file each, and their airports.

`Path(systems.__file__).parent` is where they are; `manager.specification` reads them.
"""
