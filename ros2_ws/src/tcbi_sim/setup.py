from setuptools import find_packages, setup

setup(
    name="tcbi_sim",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={
        "tcbi_sim": ["**/*.toml", "**/*.xml", "**/*.json", "**/*.html", "**/*.css", "**/*.js", "**/*.safetensors"]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/tcbi_sim"]),
        ("share/tcbi_sim", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The tcbi developers",
    maintainer_email="tcbi@example.org",
    description="Rigs, physical effects, model versions, batch simulation and the sim node.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "sim_node = tcbi_sim.sim_node:main",
            "description_node = tcbi_sim.description_node:main",
        ],
    },
)
