from setuptools import setup

setup(
    name="chsel_touch",
    version="0.2.0",
    packages=["chsel_touch"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/chsel_touch"]),
        ("share/chsel_touch", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["node = chsel_touch.node:main"]},
)
