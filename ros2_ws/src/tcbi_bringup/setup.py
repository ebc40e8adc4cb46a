from setuptools import find_packages, setup

setup(
    name="tcbi_bringup",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"tcbi_bringup": ["**/*.toml", "**/*.json", "**/*.html", "**/*.css", "**/*.js", "**/*.safetensors"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/tcbi_bringup"]),
        ("share/tcbi_bringup", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The tcbi developers",
    maintainer_email="tcbi@example.org",
    description="Launcher, emulated robot, the tcbi command and the demo.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "emulated_robot = tcbi_bringup.emulated_robot.main:main",
            "experimenter_node = tcbi_bringup.emulated_robot.experimenter_node:main",
            "tcbi = tcbi_bringup.cli:main",
        ],
    },
)
